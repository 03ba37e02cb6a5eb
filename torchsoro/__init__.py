"""torchsoro: pneumatic soft robots designed by gradient through a differentiable visco-hyperelastic MPM."""

from torchsoro.actuation import Waveform, read_pressure_csv, square_wave
from torchsoro.contact import Plane, ground
from torchsoro.domain import Chamber, Domain, Region
from torchsoro.errors import SimulationDiverged
from torchsoro.field import DesignField
from torchsoro.lagrangian import AugmentedLagrangian, Plateau
from torchsoro.loads import Drag, Force, PointMass, Spring
from torchsoro.material import Body, Gas, Prony, Solid, fill, simp, stable_step
from torchsoro.objective import center_of_gravity, intermediate_density, stride, total_mass, travel
from torchsoro.runtime import init
from torchsoro.simulator import Simulator, Trajectory

__version__ = "0.1.0"

__all__ = [
    "AugmentedLagrangian",
    "Body",
    "Chamber",
    "DesignField",
    "Domain",
    "Drag",
    "Force",
    "Gas",
    "Plane",
    "Plateau",
    "PointMass",
    "Prony",
    "Region",
    "SimulationDiverged",
    "Simulator",
    "Solid",
    "Spring",
    "Trajectory",
    "Waveform",
    "center_of_gravity",
    "fill",
    "ground",
    "init",
    "intermediate_density",
    "read_pressure_csv",
    "simp",
    "square_wave",
    "stable_step",
    "stride",
    "total_mass",
    "travel",
]
