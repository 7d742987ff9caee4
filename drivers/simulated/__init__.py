"""The roles of a bench, played by instruments of one simulated laboratory."""

from drivers.simulated.instruments import (
    SimulatedCamera,
    SimulatedGenerator,
    SimulatedSynthesizers,
)
from drivers.simulated.lab import SimulatedLab

__all__ = ["SimulatedCamera", "SimulatedGenerator", "SimulatedLab", "SimulatedSynthesizers"]
