"""The processes of a drive in simulated time: the very loops of plant and controller, in one
process, on a clock and a network that are simulated. A run is the same to the bit each time.

:mod:`.scheduler` lets threads take turns in simulated time, :mod:`.network` stands in for Zenoh
with the links that a relay emulates, :mod:`.system` starts the processes and directs a run.
"""

from bayesrace.operation.simulation.network import Direction
from bayesrace.operation.simulation.system import SimulatedSystem

__all__ = ["Direction", "SimulatedSystem"]
