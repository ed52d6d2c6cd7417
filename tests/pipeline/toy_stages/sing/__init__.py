from pydantic.dataclasses import dataclass

from pipeline.config.settings import SETTINGS
from pipeline.run.stage import Loan, Stage


@dataclass(frozen=True, config=SETTINGS)
class SingSettings:
    tune: str = "hum"  # or a file, or subject:NAME for what another's bend stage made


def loans(settings):
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
