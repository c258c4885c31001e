"""The GP residual as data (:mod:`.weights`) and as an expression (:mod:`.expression`, CasADi)."""

from bayesrace.gp.weights import (
    FEATURES,
    KERNELS,
    OUTPUTS,
    UNITS,
    GpOutput,
    GpWeights,
    decode_weights,
    encode_weights,
    read_weights,
    write_weights,
    zero_weights,
)

__all__ = [
    "FEATURES",
    "KERNELS",
    "OUTPUTS",
    "UNITS",
    "GpOutput",
    "GpWeights",
    "decode_weights",
    "encode_weights",
    "read_weights",
    "write_weights",
    "zero_weights",
]
