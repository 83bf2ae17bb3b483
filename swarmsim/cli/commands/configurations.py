"""Commands about configuration files and sites."""

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter
from cyclopts.validators import Number

from swarmsim.cli.app import command

Kind = Literal["vehicles", "sites", "missions", "detectors", "sensors", "nuclides", "materials", "policies"]
ModelKind = Literal["mission", "vehicle", "site", "detector", "sensor", "nuclide", "material"]


@command
def check(*paths: Path) -> None:
    """Validate configuration files of any kind, and tell everything that is wrong with them.

    For example:
        swarmsim check configs/missions/recon.yaml
        swarmsim check my_vehicle.yaml configs/nuclides/*.yaml
        swarmsim check configs

    Parameters
    ----------
    paths
        Files, or folders whose YAML files are all checked. What a file describes is told from its folder
        (missions, vehicles, sites …) or from its fields.
    """
    from swarmsim.cli.files import check_files

    check_files(paths)


@command
def schema(kind: ModelKind = "mission") -> None:
    """Print the JSON schema of a kind of configuration file, e.g. for an editor's completion.

    For example:
        swarmsim schema
        swarmsim schema vehicle > vehicle.schema.json

    Parameters
    ----------
    kind
        Which configuration file; mission by default.
    """
    from swarmsim.cli.files import print_schema

    print_schema(kind)


@command(name="list")
def list_(kind: Kind | None = None) -> None:
    """List what is available: vehicles, sites, missions, detectors, sensors, nuclides, materials and policies.

    For example:
        swarmsim list
        swarmsim list nuclides

    Parameters
    ----------
    kind
        List this kind only.
    """
    from swarmsim.cli.files import list_available

    list_available(kind)


@command
def init(folder: Path) -> None:
    """Copy the shipped configurations to FOLDER/configs, to be edited; names found there come before the shipped ones.

    For example:
        swarmsim init .
        swarmsim init my_project && cd my_project && swarmsim run recon

    Parameters
    ----------
    folder
        Where to put 'configs'; made if needed. An existing 'configs' is never overwritten.
    """
    from swarmsim.cli.files import copy_configurations

    copy_configurations(folder)


@command
def import_site(
    file: Path,
    *,
    out: Path,
    unit: Annotated[float | None, Parameter(validator=Number(gt=0))] = None,
    height_unit: Annotated[float | None, Parameter(validator=Number(gt=0))] = None,
    up: Literal["X", "Y", "Z"] | None = None,
    cell: Annotated[float | None, Parameter(validator=Number(gt=0))] = None,
    ground: Annotated[tuple[str, ...], Parameter(consume_multiple=False)] = (),
    plane: Annotated[float | None, Parameter(validator=Number(gt=0, lte=500))] = None,
    licence: str | None = None,
    overrides: Annotated[tuple[str, ...], Parameter(name="--set", consume_multiple=False)] = (),
    guess: Annotated[bool, Parameter(negative="--no-guess")] = True,
    force: bool = False,
) -> None:
    """Turn a mesh (.dae, .obj, .glb, .stl) or an elevation model (GeoTIFF) into a site.

    For example:
        swarmsim import-site farm.dae --out configs/sites/farm
        swarmsim import-site yard.obj --out configs/sites/yard --unit 0.01 --up Y
        swarmsim import-site yard.glb --out configs/sites/yard --ground 'terrain*'
        swarmsim import-site alps.tif --out configs/sites/alps --cell 2
        swarmsim import-site house.dae --out configs/sites/house --plane 20
        swarmsim import-site scan.obj --out configs/sites/scan --set holes_max=0.3 --set default_material=brick

    Parameters
    ----------
    file
        The mesh or the elevation model.
    out
        Folder of the new site; its name is the site's name.
    unit
        Metres of one unit of the file, where the file does not say or is wrong.
    height_unit
        Metres of one unit of the heights of an elevation model, where they differ from the file's or it does not say.
    up
        The axis of the file that points up, where the file does not say or is wrong.
    cell
        Size of the cells of the height maps, in metres.
    ground
        Pattern of the materials or geometries that are bare ground; may be given again and again.
    plane
        Lay level ground at height 0 under a model that has none, such as a building, and this far around it, in metres.
    licence
        Licence of the file, to be written into the site.
    overrides
        Any other field of site.yaml, as field=value (see 'swarmsim schema site'); may be given again and again.
    guess
        Guess materials from the names in the mesh (the default) and write them to site.yaml; --no-guess leaves it.
    force
        Replace an existing site.
    """
    from swarmsim.cli.sites import import_site_file

    given = {
        "unit_m": unit,
        "height_unit_m": height_unit,
        "up_axis": up,
        "ground": list(ground) or None,
        "plane": None if plane is None else {"margin_m": plane},
    }
    import_site_file(file, out, given, overrides, cell, licence, guess, force)
