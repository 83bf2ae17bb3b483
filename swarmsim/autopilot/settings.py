"""Settings of one kind of vehicle or peer: a file of ``configs/autopilots``."""

from typing import TypeVar

from swarmsim.config.base import Model
from swarmsim.config.errors import InputError
from swarmsim.config.files import config_dirs, is_file
from swarmsim.config.load import load_model

AnyModel = TypeVar("AnyModel", bound=Model)


def load_settings(name: str, model: type[AnyModel]) -> AnyModel:
    """The settings ``autopilots/NAME.yaml``, from the working folder's ``configs`` or the shipped ones.

    Raises `InputError` where the file is missing or wrong.
    """
    for folder in config_dirs():
        file = folder / "autopilots" / f"{name}.yaml"
        if is_file(file):
            settings: AnyModel = load_model(file, model)
            return settings
    raise InputError.of(f"the settings autopilots/{name}.yaml are missing")
