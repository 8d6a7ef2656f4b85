"""`python -m codesign`: look after the installation. The studies are run as `python -m studies.NAME`."""

import argparse
import sys
from importlib.metadata import PackageNotFoundError, version

STUDIES = """
what to run:
  make lens-opt                    set everything up and optimise a lens for event flow
  python -m studies.NAME --help    a study and its options (lens_opt, placement, gradient_flow, speed_error, stability)
"""


def main(arguments=None):
    """Parse the command line and run it. Returns the exit code."""
    try:
        installed = version("codesign")
    except PackageNotFoundError:
        installed = "(not installed)"
    parser = argparse.ArgumentParser(
        prog="python -m codesign",
        description="Differentiable co-design of a lens, its mount, an event camera and event flow.",
        epilog=STUDIES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"codesign {installed}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    doctor = commands.add_parser(
        "doctor", help="what is installed, what is missing, what to do; exit 0 only when a render works"
    )
    doctor.add_argument(
        "--device", choices=("cpu", "cuda"), default="cpu", help="where the trial render runs (default: cpu)"
    )
    chosen = parser.parse_args(arguments)
    if chosen.command is None:
        parser.print_help()
        return 0
    from codesign.doctor import main as run_doctor  # imports drjit, which --help does without

    return run_doctor(chosen.device)


if __name__ == "__main__":
    sys.exit(main())
