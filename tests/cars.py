"""Cars that differ from others by single numbers."""

from collections.abc import Iterator, Mapping
from typing import Any

from bayesrace.vehicles import Car

__all__ = ["with_numbers"]


def with_numbers(car: Car, values: Mapping[str, float]) -> Car:
    """The car with these numbers, by flat names such as ``mass_kg``, ``cm1`` or ``front_b``."""
    data = car.model_dump()
    places = {name: (place, key) for name, place, key in _places(data, "")}
    for name, value in values.items():
        place, key = places[name]
        place[key] = value
    return Car.model_validate(data)


def _places(data: dict[str, Any], before: str) -> Iterator[tuple[str, dict[str, Any], str]]:
    """Flat name, and the dictionary and key where the value is."""
    for key, value in data.items():
        if isinstance(value, dict) and key != "tuning":
            inner = f"{key}_" if key in ("front", "rear") else ""
            yield from _places(value, before + inner)
        else:
            yield before + key, data, key
