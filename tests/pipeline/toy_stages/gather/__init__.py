from pydantic.dataclasses import dataclass

from pipeline.config.settings import SETTINGS
from pipeline.run.stage import Stage


@dataclass(frozen=True, config=SETTINGS)
class GatherSettings:
    upper: bool = False  # changes the text
    unused: int = 0  # changes nothing that is published
    limits: tuple[int, ...] = (1, 2)
    extra: str = "none"  # or a file whose text is added
    made_up: str = ""  # text instead of footage


STAGE = Stage(
    "gather",
    1,
    GatherSettings,
    "tests.pipeline.toy_stages.work:gather",
    reads_source=lambda settings: not settings.made_up,
    path_settings=("extra",),
)
