"""Models whose every number says where it is from."""

from collections.abc import Iterator
from typing import Any

from pydantic import model_validator

from swarmsim.config.base import Model


def _numeric_paths(value: Any, path: str = "") -> Iterator[str]:
    """Dotted path of every number in nested mappings and sequences; items of a sequence are numbered from 0."""
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _numeric_paths(item, f"{path}.{key}" if path else str(key))
    elif isinstance(value, list | tuple):
        for index, item in enumerate(value):
            yield from _numeric_paths(item, f"{path}.{index}")
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield path


class Sourced(Model):
    """A model whose every number has its source in ``sources``: dotted path to where the number is from.

    A path covers its children: ``rotor`` covers ``rotor.radius_m``, ``rotors`` covers ``rotors.0.position_m.2``. Of a
    value that a file changes in what it extends, the inherited source does not hold (`swarmsim.config.citations`).
    """

    sources: dict[str, str]

    @model_validator(mode="after")
    def _every_number_has_a_source(self) -> "Sourced":
        numbers = list(_numeric_paths(self.model_dump(exclude={"sources"})))
        named = tuple(self.sources)

        def covers(source: str, path: str) -> bool:
            return path == source or path.startswith(f"{source}.")

        missing = [path for path in numbers if not any(covers(source, path) for source in named)]
        unused = [source for source in named if not any(covers(source, path) for path in numbers)]
        empty = [source for source in named if not self.sources[source].strip()]
        faults = [
            f"{what}: {', '.join(paths[:8])}{' …' if len(paths) > 8 else ''}"
            for what, paths in (
                ("no source is given for", missing),
                ("no number stands at the path of the source", unused),
                ("the source is empty for", empty),
            )
            if paths
        ]
        if faults:
            raise ValueError("; ".join(faults) + " (a path such as 'rotor' covers everything below it)")
        return self
