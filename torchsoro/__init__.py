"""torchsoro: pneumatic soft robots designed by gradient through a differentiable visco-hyperelastic MPM."""

from torchsoro.design.density import fill, simp
from torchsoro.design.domain import Chamber, Domain, Region
from torchsoro.design.field import DesignField
from torchsoro.design.lagrangian import AugmentedLagrangian, Plateau
from torchsoro.design.objective import center_of_gravity, intermediate_density, stride, total_mass, travel
from torchsoro.errors import SimulationDiverged
from torchsoro.simulation.actuation import Waveform, read_pressure_csv, square_wave
from torchsoro.simulation.contact import Plane, ground
from torchsoro.simulation.loads import Drag, Force, PointMass, Spring
from torchsoro.simulation.material import Body, Gas, Prony, Solid
from torchsoro.simulation.runtime import init
from torchsoro.simulation.simulator import Simulator, Trajectory
from torchsoro.simulation.stability import stable_step

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
