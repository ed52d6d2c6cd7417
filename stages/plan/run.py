"""Running the plan stage."""

from __future__ import annotations

from pipeline.clip.plan import COUNTED, write_plan
from pipeline.numba_kernels import threads
from pipeline.run.stage import Context
from stages.plan.decide import decide
from stages.plan.measure import read_inputs


def run(context: Context) -> None:
    """Decides and publishes ``plan.json``.

    Raises:
        UserError: what ingest or fit published cannot be used.
    """
    with threads(1):
        inputs = read_inputs(context.inputs["ingest"], context.inputs["fit"], context.body_file)
        plan = decide(inputs, context.settings)
    write_plan(context.output / "plan.json", plan)
    told = [one.effect.replace("_", " ") for one in plan.decisions if one.forced]
    if told:
        context.log(f"set, not decided by the clip: {', '.join(told)}; plan.json says what it calls for")
    numbers = ("gaussians", *COUNTED)  # what they say matters more than that they are on
    for effect in numbers:
        context.log(plan[effect].why)
    for on, word in ((True, "on"), (False, "off")):
        chosen = [one for one in plan.decisions if one.on == on and one.effect not in numbers]
        names = [one.effect.replace("_", " ") for one in chosen]
        context.log(f"{word}: {', '.join(names) or 'nothing'}")
