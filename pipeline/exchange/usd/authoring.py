"""Writes prims and attributes straight into a layer, with a hundredth of the calls of schemas.

The writer and the exact reader use the same tables of attributes by name: one writes the values,
the other compares them.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from pipeline.exchange.usd.prim_names import NAMESPACE

Attributes = Mapping[str, tuple[str, Any] | tuple[str, Any, str]]
"""Type name, value and connected output, if any, of each attribute by name.

The prefix "uniform " of a type sets its variability. Inputs and outputs may have the value None. An
output is named by its path below the material.
"""

UNIFORM = "uniform "


def text_attributes(fields: Mapping[str, str], record: Any) -> dict[str, tuple[str, Any]]:
    """Return attributes of a record's fields that are texts; `fields` has their names."""
    return {name: ("string", getattr(record, field)) for field, name in fields.items()}


def add_prim(layer: Any, path: str, type_name: str, schemas: Sequence[str] = ()) -> Any:
    """Return a new prim of a type, with API schemas applied."""
    from pxr import Sdf

    prim = Sdf.CreatePrimInLayer(layer, path)
    prim.specifier = Sdf.SpecifierDef
    prim.typeName = type_name
    if schemas:
        prim.SetInfo("apiSchemas", Sdf.TokenListOp.Create(prependedItems=list(schemas)))
    return prim


def add_attributes(prim: Any, attributes: Attributes, material: str = "") -> None:
    """Write attributes with default values, and connections to outputs below `material`."""
    from pxr import Sdf

    for name, (kind, value, *sources) in attributes.items():
        uniform = kind.startswith(UNIFORM)
        attribute = Sdf.AttributeSpec(
            prim,
            name,
            _value_type(kind),
            Sdf.VariabilityUniform if uniform else Sdf.VariabilityVarying,
            name.startswith(NAMESPACE),
        )
        if value is not None:
            attribute.default = usd_value(kind, value)
        if sources:
            paths = [_target(f"{material}/{source}") for source in sources]
            attribute.connectionPathList.explicitItems = paths


def add_relationship(prim: Any, name: str, target: str) -> None:
    """Write a relationship to one prim."""
    from pxr import Sdf

    relationship = Sdf.RelationshipSpec(prim, name, False)
    relationship.targetPathList.explicitItems = [_target(target)]


def _target(path: str) -> Any:
    """Return the path of a prim as other prims name it, without variant selections."""
    from pxr import Sdf

    return Sdf.Path(path).StripAllVariantSelections()


@functools.cache
def _value_type(kind: str) -> Any:
    from pxr import Sdf

    return Sdf.ValueTypeNames.Find(kind.removeprefix(UNIFORM))


def usd_value(kind: str, value: Any) -> Any:
    """Return a value as the USD type `kind`."""
    return _converter(kind)(value)


@functools.cache
def _converter(kind: str) -> Callable[[Any], Any]:
    """Return the converter to a USD type; cached, since scenes have 10^5 values."""
    from pxr import Sdf

    python_class = Sdf.AssetPath if kind == "asset" else _value_type(kind).type.pythonClass
    if hasattr(python_class, "FromNumpy"):
        return lambda values: python_class.FromNumpy(np.ascontiguousarray(values))
    return python_class or (lambda value: value)  # numbers and texts have no class
