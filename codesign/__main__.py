"""`codesign`, or `python -m codesign`: list and run the studies, look after the installation."""

import argparse
import os
import runpy
import sys

import codesign
from codesign import shipped
from codesign.interrupt import written_out

EXAMPLES = """
for example:
  codesign list                    every study with its question
  codesign run lens_opt --quick    the same as python -m studies.lens_opt --quick in a checkout
  make lens-opt                    set everything up and optimise a lens for event flow
"""


def main(arguments: list[str] | None = None) -> int:
    """Parse the command line and run it. Returns the exit code; a study ends by itself
    (SystemExit)."""
    with written_out():
        return _main(arguments)


def _main(arguments):
    parser = argparse.ArgumentParser(
        prog="codesign",
        description="Differentiable co-design of a lens, its mount, an event camera and event flow.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"codesign {codesign.__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    commands.add_parser("list", help="every study with its question")
    run = commands.add_parser("run", help="run a study: codesign run NAME [OPTIONS]")
    run.add_argument("name", metavar="NAME", help="a study out of the list")
    run.add_argument(
        "options", nargs=argparse.REMAINDER, metavar="OPTIONS", help="what the study is told"
    )
    doctor = commands.add_parser(
        "doctor",
        help="what is installed, what is missing, what to do; exit 0 only when a render works",
    )
    doctor.add_argument(
        "--device",
        choices=("cpu", "cuda"),
        default="cpu",
        help="where the trial render runs (default: cpu)",
    )
    chosen = parser.parse_args(arguments)
    if chosen.command is None:
        parser.print_help()
        return 0
    if chosen.command == "doctor":
        from codesign.doctor import main as run_doctor  # imports drjit, which the rest does without

        return run_doctor(chosen.device)
    shipped.on_path()
    from studies.frame import listing

    if chosen.command == "list":
        print(listing.show())
        return 0
    return _run(chosen.name, chosen.options, listing.refusal(chosen.name))


def _run(name, options, refusal):
    if refusal:
        print(f"error: {refusal}", file=sys.stderr)
        return 2
    # what a study starts by `python -m studies.…` imports nothing of the folder it runs in
    os.environ["PYTHONSAFEPATH"] = "1"
    shipped.begin_imports()
    sys.argv = [f"studies.{name}", *options]
    runpy.run_module(f"studies.{name}", run_name="__main__", alter_sys=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
