from pydantic.dataclasses import dataclass

from pipeline.config.settings import SETTINGS
from pipeline.run.stage import Stage


@dataclass(frozen=True, config=SETTINGS)
class BendSettings:
    angle: float = 1.0
    fail: str = ""  # "user", "bug", "disk", "memory", "killed"


STAGE = Stage("bend", 1, BendSettings, "tests.pipeline.toy_stages.work:bend", needs={"gather": ("text.txt",)})
