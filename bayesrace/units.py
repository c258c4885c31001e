"""Numbers of other programs in our units: factors to SI, and the affine entries of maps in TOML."""

import math
import re
from typing import Any, ClassVar, Final, Literal, Self

from pydantic import ConfigDict, Field, model_validator

from bayesrace.errors import InputError
from bayesrace.strict import StrictModel

__all__ = ["Affine", "Section", "factor_of"]

_UNITS: Final[dict[str, dict[str, float]]] = {
    "m": {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3, "in": 0.0254, "ft": 0.3048},
    "m/s": {
        "m/s": 1.0, "mm/s": 1e-3, "cm/s": 1e-2, "km/h": 1 / 3.6, "kmph": 1 / 3.6, "mph": 0.44704,
        "ft/s": 0.3048,
    },
    "m/s2": {"m/s2": 1.0},
    "rad": {"rad": 1.0, "1": 1.0, "deg": math.pi / 180, "°": math.pi / 180, "turn": 2 * math.pi},
    "rad/s": {
        "rad/s": 1.0, "1/s": 1.0, "deg/s": math.pi / 180, "°/s": math.pi / 180,
        "rpm": math.pi / 30, "rev/min": math.pi / 30,
    },
    "1": {"1": 1.0, "%": 0.01},
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9},
}  # fmt: skip
"""Of each SI unit, factors from others. Not here: what leaves open whether it counts turns or
radians, such as 1/min and Hz, and angles for a plain number, because a duty cycle in degrees is a
mistake."""

Sign = Literal[1, -1]


class Section(StrictModel):
    """A table of a file that a user writes."""

    model_config = ConfigDict(populate_by_name=True)


class Affine(Section):
    """``sign * scale * value + offset``; the scale follows from the unit unless it is given."""

    named: ClassVar[str]
    """The key of the text that will do alone."""

    unit: str | None = Field(None, description="its unit; default: as it declares, or SI")
    sign: Sign = Field(1, description="-1: positive the other way round; a factor is `scale`")
    scale: float | None = Field(None, description="factor in place of the unit's")
    offset: float = Field(0.0, description="added after scaling, in the unit of the result")

    @model_validator(mode="before")
    @classmethod
    def _short(cls, entry: Any) -> Any:
        if isinstance(entry, dict | cls):
            return entry
        if isinstance(entry, str):
            return {cls.named: entry}
        raise ValueError(f'give the name of a variable, or {{ {cls.named} = "name", … }}')

    @model_validator(mode="after")
    def _one_conversion(self) -> Self:
        if self.scale == 0.0:
            raise ValueError("scale is 0, which loses the value")
        if self.scale is not None and self.unit is not None:
            raise ValueError(
                "unit and scale both convert: give one of them (the other way round: sign = -1)"
            )
        return self

    def factor(self, name: str, wanted: str, declared: str | None = None) -> float:
        """The scale, or else that from the unit, or the one that is ``declared``, to ``wanted``; 1
        if there is none of them, which is SI then. InputError if it does not convert."""
        unit = declared if self.unit is None else self.unit
        if self.scale is not None or unit in (None, "", "-"):
            return self.scale or 1.0
        factor = factor_of(unit, wanted)
        if factor is None:
            raise InputError(
                f"the unit '{unit}' of '{name}' does not convert to '{wanted}': correct `unit`, or "
                "give `scale` instead of it"
            )
        return factor


def factor_of(unit: str | None, wanted: str) -> float | None:
    """Factor from a value in ``unit``, also as FMI tools spell it (m.s-1), to one in the SI unit
    ``wanted``; None if it does not convert."""
    spelled = re.sub(r"[.*· ]?([a-z]+)\^?-(\d)$", r"/\1\2", unit or "")
    spelled = re.sub(r"(?<=/[a-z])1$", "", spelled).replace("^2", "2").replace("²", "2")
    return _UNITS[wanted].get(spelled)
