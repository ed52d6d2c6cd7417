"""The names of the layouts that can be read, those that are told apart first being first.

Written here, because settings are checked where nothing heavy is imported; each is a module of
``stages/ingest/datasets``.
"""

from typing import Literal, get_args

Layout = Literal[
    "zju", "wildavatar", "insta", "xhumans", "persona", "pose2sim", "neuman", "prepared", "talkshow", "plain"
]  # fmt: skip
LAYOUTS: tuple[Layout, ...] = get_args(Layout)
