"""Cars as data and as TOML files (:mod:`.parts`, :mod:`.parameters`), their size-dependent numbers
(:mod:`.tuning`), and their models as expressions (:mod:`.models`, CasADi)."""

from bayesrace.vehicles.parameters import (
    DEFAULT_CAR,
    Car,
    CarSetting,
    builtin_cars,
    car_text,
    default_car,
    described_car,
    get_car,
    read_car,
    write_car,
)
from bayesrace.vehicles.tuning import Tuning

__all__ = [
    "DEFAULT_CAR",
    "Car",
    "CarSetting",
    "Tuning",
    "builtin_cars",
    "car_text",
    "default_car",
    "described_car",
    "get_car",
    "read_car",
    "write_car",
]
