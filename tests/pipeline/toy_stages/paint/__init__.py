from pydantic.dataclasses import dataclass

from pipeline.config.settings import SETTINGS, Fraction, Iterations
from pipeline.run.stage import Stage


@dataclass(frozen=True, config=SETTINGS)
class PaintSettings:
    iterations: Iterations = 3
    rate: Fraction | None = None
    kernels: bool = False  # there are some to compile


STAGE = Stage(
    "paint",
    1,
    PaintSettings,
    "tests.pipeline.toy_stages.work:paint",
    needs={"gather": ("text.txt",), "bend": ("*",)},
    compile_ahead=lambda settings: (
        "tests.pipeline.toy_stages.work:compile_slowly" if settings.kernels else ""
    ),
)
