"""Cars as data (:mod:`.parts`, :mod:`.parameters`), their size-dependent numbers (:mod:`.tuning`)
and TOML files (:mod:`.files`), and their models as expressions (:mod:`.models`, CasADi)."""

from bayesrace.vehicles.files import (
    DEFAULT_CAR,
    CarSetting,
    builtin_cars,
    car_text,
    default_car,
    described_car,
    get_car,
    read_car,
    write_car,
)
from bayesrace.vehicles.parameters import CarParameters
from bayesrace.vehicles.tuning import Tuning

__all__ = [
    "DEFAULT_CAR",
    "CarParameters",
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
