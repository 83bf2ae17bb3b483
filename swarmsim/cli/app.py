"""The application of the command line, and how its values are read."""

import re
from collections.abc import Sequence
from functools import partial

from cyclopts import App, Parameter, Token

SEED_END = 2**31


def whole(_: object, tokens: Sequence[Token]) -> int:
    """A whole number; cyclopts alone would round another one."""
    text = tokens[0].value
    if not re.fullmatch(r"[+-]?[0-9]+", text):
        raise ValueError(f"a whole number is needed, not '{text[:100]}'")
    return int(text[:100])


def _version() -> str:
    from swarmsim.versions import NOT_INSTALLED, package_versions

    version = package_versions(())["swarmsim"]
    return (
        "swarmsim, run from its source folder without being installed"
        if version == NOT_INSTALLED
        else f"swarmsim {version}"
    )


app = App(
    name="swarmsim",
    help="Simulate teams of aerial and ground robots, and their search for radioactive sources.",
    help_epilogue=(
        "Examples:\n"
        "    swarmsim run recon           fly the shipped mission, results in runs/recon\n"
        "    swarmsim view runs/recon     watch it in the Rerun viewer\n"
        "    swarmsim init my_project     copy the configurations out, to edit them\n"
        "    swarmsim list vehicles       what there is to build a team of\n\n"
        "'swarmsim COMMAND --help' says more of a command, with examples.\n"
        "Exit codes: 0 done, 2 wrong input (told on standard error), 3 a doubtful answer of 'run --strict',\n"
        "4 a flight that did not end as planned, 130 stopped with Ctrl-C, 143 by SIGTERM, 129 by SIGHUP,\n"
        "136 a stand-in autopilot that died as the real one would."
    ),
    version=_version,
    help_format="plaintext",
    suppress_keyboard_interrupt=False,
    default_parameter=Parameter(show_default=False, negative=""),
)


command = partial(app.command, help_epilogue="")  # the epilogue above belongs to the whole program
