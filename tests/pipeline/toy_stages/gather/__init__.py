import dataclasses

from pipeline.stage import Stage


@dataclasses.dataclass(frozen=True)
class GatherSettings:
    upper: bool = False  # changes the text
    unused: int = 0  # changes nothing that is published
    limits: tuple[int, ...] = (1, 2)


STAGE = Stage("gather", 1, GatherSettings, "tests.pipeline.toy_stages.work:gather", reads_source=True)
