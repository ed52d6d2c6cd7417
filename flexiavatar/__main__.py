"""The command ``flexiavatar``: doit with this project's tasks, from any folder.

    flexiavatar run subject=me source=clip.mp4      as ``doit run`` in a checkout
    flexiavatar clean subject=me                    any command of doit: run, list, clean, info ...
    flexiavatar settings train                      what can be set

Results, fetched assets and a user's own subjects and presets lie in ``./data``, or where data= says.
"""

from __future__ import annotations

import sys

from flexiavatar import ROOT, use_checkout


def main(arguments: list[str] | None = None) -> int:
    """Runs one command; returns the exit status."""
    words = sys.argv[1:] if arguments is None else arguments
    use_checkout()
    if not words or words[0] in ("-h", "--help", "help"):
        print((__doc__ or "").strip())
        return 0
    if words[0] == "settings":
        from pipeline.__main__ import main as run_stage

        return run_stage(words)
    if "=" in words[0] or ":" in words[0]:  # doit, too, runs where no command is named
        words = ["run", *words]
    return run_doit(words)


def run_doit(words: list[str]) -> int:
    """Runs a command of doit with the tasks of this project's dodo.py."""
    from doit.doit_cmd import DoitMain

    sys.argv = ["flexiavatar", *words]  # dodo.py looks for its NAME=VALUE words there
    command, *rest = words
    return int(DoitMain().run([command, "-f", str(ROOT / "dodo.py"), *rest]) or 0)


if __name__ == "__main__":
    sys.exit(main())
