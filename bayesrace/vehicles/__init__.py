"""Cars as data (:mod:`.parameters`) and their models as expressions (:mod:`.models`, CasADi)."""

from bayesrace.vehicles.parameters import CARS, CarParameters, Pacejka, get_car

__all__ = ["CARS", "CarParameters", "Pacejka", "get_car"]
