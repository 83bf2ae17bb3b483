"""What may stand at a place of a configuration, read from the JSON schema of its model."""

from functools import cache
from typing import Any

from pydantic import TypeAdapter

from swarmsim.config.documents import Place

Schema = dict[str, Any]


class Shape:
    """The JSON schema of a model, asked by place."""

    def __init__(self, cls: Any):
        """Read the schema of the model (or union of models) ``cls``."""
        self._root: Schema = TypeAdapter(cls).json_schema()

    def at(self, place: Place, data: Any) -> Schema | None:
        """Schema of the value at ``place``; None where nothing may stand. ``data`` tells which model of a union."""
        schema, value = self._resolve(self._root, data), data
        for step in place:
            inner = self._step(schema, step)
            if inner is None:
                return None
            value = item(value, step)
            schema = self._resolve(inner, value)
        return schema

    def fields(self, place: Place, data: Any) -> list[str]:
        """Names of the fields of the mapping at ``place``; empty when it is no mapping with named fields."""
        schema = self.at(place, data)
        return list(schema.get("properties", ())) if schema else []

    def describe(self, place: Place, data: Any) -> str | None:
        """What may stand at ``place`` in words: type, bounds, choices."""
        schema = self.at(place, data)
        return None if schema is None else self._words(schema)

    def words(self, schema: Schema) -> str:
        """What a schema without references allows, in words."""
        return self._words(schema)

    def choices(self, place: Place, data: Any) -> list[str]:
        """Words to choose from at ``place``; empty where there are none."""
        schema = self.at(place, data) or {}
        options = [self._resolve(option, None) for option in schema.get("anyOf", [schema])]
        return [str(word) for option in options for word in (*option.get("enum", ()), option.get("const")) if word]

    def _step(self, schema: Schema, step: str | int) -> Schema | None:
        if isinstance(step, int):
            prefix = schema.get("prefixItems")
            if prefix is not None:
                return prefix[step] if 0 <= step < len(prefix) else None
            return schema.get("items")
        if step in schema.get("properties", {}):
            inner: Schema = schema["properties"][step]
            return inner
        for named in schema.get("patternProperties", {}).values():
            found: Schema = named
            return found
        extra = schema.get("additionalProperties")
        if isinstance(extra, dict):
            return extra
        return {} if extra is True else None

    def _resolve(self, schema: Schema, value: Any) -> Schema:
        while "$ref" in schema:
            schema = self._root["$defs"][schema["$ref"].rsplit("/", 1)[1]]
        if "oneOf" in schema and "discriminator" in schema:
            mapping = schema["discriminator"]["mapping"]
            tag = item(value, schema["discriminator"]["propertyName"])
            if isinstance(tag, str) and tag in mapping:
                return self._resolve({"$ref": mapping[tag]}, value)
        if "anyOf" in schema:
            real = [option for option in schema["anyOf"] if option.get("type") != "null"]
            if isinstance(value, list):  # where one or several may stand, it says which of the two is meant
                real = [option for option in real if option.get("type") == "array"] or real
            if len(real) == 1:
                return self._resolve(real[0], value)
        return schema

    def _words(self, schema: Schema) -> str:
        schema = self._resolve(schema, None)
        if "enum" in schema:
            return "one of " + ", ".join(map(str, schema["enum"]))
        if "const" in schema:
            return str(schema["const"])
        if "anyOf" in schema:
            return " or ".join(self._words(option) for option in schema["anyOf"])
        match schema.get("type"):
            case "boolean":
                return "true or false"
            case "number" | "integer" as kind:
                bounds = _bounds(schema)
                return ("a number" if kind == "number" else "a whole number") + (f" {bounds}" if bounds else "")
            case "string":
                if "pattern" in schema:
                    return "a name of letters, digits, '_', '.' and '-' that begins with a letter or digit"
                return "a text"
            case "array":
                return self._list_words(schema)
        if "properties" in schema:
            return "a mapping with " + ", ".join(schema["properties"])
        return "a mapping of names to values" if schema.get("type") == "object" else "any value"

    def _list_words(self, schema: Schema) -> str:
        if "prefixItems" in schema:
            items = [self._words(inner) for inner in schema["prefixItems"]]
            if len(set(items)) == 1:
                return f"a list of {len(items)} values, each {items[0]}"
            return f"[{', '.join(items)}]"
        low, high = schema.get("minItems"), schema.get("maxItems")
        count = f" of {low} to {high}" if low and high else f" of at least {low}" if low else ""
        count = f" of at most {high}" if high and not low else count
        inner = self._words(schema.get("items", {}))
        return f"a list{count}{' values' if count else ''}, each {inner}"


def _bounds(schema: Schema) -> str:
    low, high = schema.get("minimum"), schema.get("maximum")
    above, below = schema.get("exclusiveMinimum"), schema.get("exclusiveMaximum")
    if low is not None and high is not None:
        return f"from {_number(low)} to {_number(high)}"
    parts = [
        f"{word} {_number(bound)}"
        for word, bound in (("at least", low), ("greater than", above), ("at most", high), ("less than", below))
        if bound is not None
    ]
    return " and ".join(parts)


def _number(bound: float) -> str:
    whole = isinstance(bound, int) or (bound.is_integer() and abs(bound) < 1e7)
    return str(int(bound)) if whole else f"{bound:g}"


def item(value: Any, step: str | int) -> Any:
    """``value[step]``, or None where there is no such thing."""
    try:
        return value[step]
    except (TypeError, KeyError, IndexError):
        return None


@cache
def shape_of(cls: Any) -> Shape:
    """The `Shape` of a model, made once."""
    return Shape(cls)
