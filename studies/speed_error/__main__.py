"""What does every stage cost, and how far is it off? Times, memory and errors, beside peers that
are installed.

    python -m studies.speed_error --stages lens events flow

measures those stages, one after the other, on one page; see --stages for what there is. Times are
medians; the processor's stand beside the clock's, since machines are shared. What is compared is
measured in turns, in the same run. Peers: pip install "codesign[bench]" (`make lens-bench`, `make
srm-bench`).
"""

import sys

from codesign.errors import DomainError
from studies.frame.run import Run, main
from studies.frame.show import asked
from studies.speed_error import Config, chain, events, flow, frames, growth, lens, select

STAGES = {
    "chain": chain.stage,
    "select": select.stage,
    "lens": lens.stage,
    "render": frames.render_stage,
    "growth": growth.stage,
    "events": events.stage,
    "spiking": events.spiking_stage,
    "flow": flow.stage,
    "live": flow.live_stage,
}


def study(run: Run[Config]) -> None:
    config = run.config
    if config.repeats < 3 or config.rounds < 1 or not config.stages:
        raise DomainError(
            f"repeats {config.repeats}, rounds {config.rounds}, stages {config.stages}: give at least 3, 1 "
            "and one."
        )
    said = []
    figures = []
    for name in dict.fromkeys(config.stages):
        stage = STAGES[name]
        run.say(name)
        run.section(name.capitalize(), stage.__doc__ or "")
        for found in stage(run):
            (said if isinstance(found, str) else figures).append(found)
    if figures:
        said.append(asked(run, figures))
    run.finish("Speed and error", " ".join(said))


if __name__ == "__main__":
    sys.exit(main(study, Config))
