from pathlib import Path

from pydantic.dataclasses import dataclass

from pipeline.config.settings import SETTINGS
from pipeline.run.stage import Loan, Stage


@dataclass(frozen=True, config=SETTINGS)
class SingSettings:
    tune: str = "hum"  # or a file, or subject:NAME or clip:FILE for what another's bend stage made


def loans(settings):
    if settings.tune.startswith("clip:"):
        clip = Path(settings.tune.removeprefix("clip:")).absolute()
        return tuple(Loan(clip.stem, stage, ("*.txt",), clip) for stage in ("gather", "bend"))
    other = settings.tune.removeprefix("subject:")
    return (Loan(other, "bend", ("bent.txt",)),) if other != settings.tune else ()


STAGE = Stage(
    "sing",
    1,
    SingSettings,
    "tests.pipeline.toy_stages.work:sing",
    needs={"bend": ("bent.txt",)},
    path_settings=("tune",),
    on_request=True,
    words=("tune",),
    loans=loans,
)
