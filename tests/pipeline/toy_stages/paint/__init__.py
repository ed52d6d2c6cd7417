from pydantic.dataclasses import dataclass

from pipeline.config.settings import SETTINGS, Fraction, Iterations
from pipeline.run.stage import Stage


@dataclass(frozen=True, config=SETTINGS)
class PaintSettings:
    iterations: Iterations = 3
    rate: Fraction | None = None


STAGE = Stage(
    "paint",
    1,
    PaintSettings,
    "tests.pipeline.toy_stages.work:paint",
    needs={"gather": ("text.txt",), "bend": ("*",)},
)
