"""What ``swarmsim import-site`` does."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from swarmsim.cli.run import value_text
from swarmsim.config.allowed import shape_of
from swarmsim.config.base import Name
from swarmsim.config.documents import Document
from swarmsim.config.errors import InputError, Problem
from swarmsim.config.overrides import apply_overrides
from swarmsim.config.site import SiteSpec
from swarmsim.site.source_files import TIFF_SUFFIXES

WIDTH = 120  # of what is printed where there is no terminal
OPTIONS = {"name": "the folder's name (--out)", "licence": "--licence", "cell_m": "--cell"}
"""Fields of a site that have an option of their own, other than those in `import_site_file`'s ``given``."""
GIVEN_BY = {
    "unit_m": "--unit", "height_unit_m": "--height-unit", "up_axis": "--up", "ground": "--ground", "plane": "--plane"
}  # fmt: skip
"""Options of the fields in ``given``."""


def import_site_file(
    file: Path,
    out: Path,
    given: dict[str, Any],
    overrides: Sequence[str],
    cell_m: float | None,
    licence: str | None,
    guess: bool,
    force: bool,
) -> None:
    """Import a mesh or an elevation model as a site and say what was found in it.

    ``given`` are fields of the specification by options of their own (None: not given), ``overrides`` further ones as
    ``field=value``.
    """
    if out.exists() and not force:
        raise InputError.of(
            "there is something already",
            path="--out",
            given=str(out),
            suggestion="choose another folder, or replace the site with --force",
        )
    _check_name(out)
    if given.get("height_unit_m") is not None and file.suffix.lower() not in TIFF_SUFFIXES:
        raise InputError.of(
            "is of elevation models only", path="--height-unit", given=file.name, suggestion="use --unit"
        )
    document = Document({key: value for key, value in given.items() if value is not None})
    apply_overrides(document, overrides, shape_of(SiteSpec))
    for field, option in OPTIONS.items():
        if field in document.data:
            raise InputError.of(f"is set by {option}", file="--set", path=field)

    from swarmsim.site import ImportOptions, import_site

    options = ImportOptions(
        cell_m=cell_m, fields=document.data, overwrite=force, licence=licence or ImportOptions.licence,
        guess=guess,
    )  # fmt: skip
    try:
        model = import_site(file, out, options)
    except InputError as error:
        raise InputError([_by_option(problem, out, given) for problem in error.problems]) from error
    console = Console()
    if not console.is_terminal:
        console = Console(width=WIDTH)
    table = Table("what", "value", title=escape(f"site {model.name}"), title_justify="left")
    for label, text in _rows(model.report):
        table.add_row(label, escape(text))
    console.print(table)
    for line in _lines(model.report):
        console.print(line, markup=False, highlight=False, soft_wrap=True)
    console.print(f"Site: {out}", markup=False, highlight=False, soft_wrap=True)
    if options.preview:
        console.print(f"Preview: {out / 'preview.png'}", markup=False, highlight=False, soft_wrap=True)


def _by_option(problem: Problem, out: Path, given: Mapping[str, Any]) -> Problem:
    """What is wrong with the specification that was to be written, told of the option that asked for it."""
    if problem.file != str(out / "site.yaml") or problem.path is None:
        return problem
    field = problem.path.split(".")[0]
    option = GIVEN_BY[field] if given.get(field) is not None else OPTIONS.get(field, "--set")
    return replace(problem, file="--set") if option == "--set" else replace(problem, file=None, path=option)


def _check_name(out: Path) -> None:
    """Raise `InputError` where the site, which has the name of its folder, would have a name that none can have."""
    try:
        TypeAdapter(Name).validate_python(out.name)
    except ValidationError:
        raise InputError.of(
            "is the folder of no name that a site can have",
            path="--out",
            given=str(out),
            allowed="letters, digits, '_', '.' and '-', beginning with a letter or digit",
            suggestion="choose another folder",
        ) from None


_APART = ("parts", "warnings", "guesses", "bounds_m", "survey_area_m", "start_places_m")


def _rows(report: dict[str, Any]) -> Iterator[tuple[str, str]]:
    if "bounds_m" in report:
        west, south, east, north = report["bounds_m"]
        yield "bounds", f"x from {west:g} to {east:g} m, y from {south:g} to {north:g} m"
    for key, label in (("survey_area_m", "survey area (m)"), ("start_places_m", "free places to start (m)")):
        if key in report:
            yield label, ", ".join(f"[{x:g}, {y:g}]" for x, y in report[key]) or "none"
    if report.get("parts"):
        yield "parts", _parts(report["parts"])
    for key, value in report.items():
        if key not in _APART:
            yield key, value_text(value)


def _parts(parts: list[dict[str, Any]]) -> str:
    """What the parts of a mesh were taken for: one line for each material, with the names of its parts."""
    names: dict[str, dict[str, None]] = {}
    for part in parts:
        names.setdefault(part["is"], {})[part["names"][0] if part["names"] else "without a name"] = None
    return "\n".join(f"{what}: {', '.join(found)}" for what, found in names.items())


def _lines(report: dict[str, Any]) -> Iterator[str]:
    """Guesses and warnings, one a line."""
    guesses = report.get("guesses", ())
    if guesses:
        yield f"{len(guesses)} materials guessed from names, written to site.yaml under obstacles (correct them there):"
        yield from (f"  {guess}" for guess in guesses)
    yield from (f"warning: {warning}" for warning in report["warnings"])
