import dataclasses

from pipeline.stage import Stage


@dataclasses.dataclass(frozen=True)
class PaintSettings:
    iterations: int = 3
    rate: float | None = None

    def __post_init__(self):
        if self.iterations < 1:
            raise ValueError(f"paint.iterations must be at least 1, not {self.iterations}")


STAGE = Stage(
    "paint",
    1,
    PaintSettings,
    "tests.pipeline.toy_stages.work:paint",
    needs={"gather": ("text.txt",), "bend": ("*",)},
)
