"""What goes into the wheel: the command, and beneath it the checkout's packages and definitions.

``pipeline`` and ``stages`` become ``flexiavatar/checkout/pipeline`` and ``flexiavatar/checkout/stages``: such
common names would stand in the way of others in an environment. The command puts that folder on the path.
"""

from setuptools import find_packages, setup

INNER = "flexiavatar.checkout"
FOUND = find_packages(include=["pipeline", "pipeline.*", "stages", "stages.*"])

setup(
    packages=[
        "flexiavatar",
        INNER,
        *(f"{INNER}.{name}" for name in FOUND),
    ],
    package_dir={INNER: "."},
    package_data={
        INNER: [
            *(f"data/{folder}/*.toml" for folder in ("presets", "subjects", "datasets")),
            *(f"data/avatars/*{end}" for end in (".md", "/*.safetensors", "/*.parquet")),
            *("data/assets.toml", "data/body/*.npz", "data/body/*.md"),
        ],
        f"{INNER}.pipeline.viewer.page": ["*.jinja", "*.js"],
        f"{INNER}.pipeline.studies": ["*.toml", "*.jinja"],
        f"{INNER}.stages.evaluate.report": ["*.jinja", "*.js"],
    },
)
