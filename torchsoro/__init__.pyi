from .design.density import fill, simp
from .design.domain import Chamber, Domain, Region
from .design.field import DesignField
from .design.lagrangian import AugmentedLagrangian, Plateau
from .design.objective import center_of_gravity, intermediate_density, stride, total_mass, travel
from .errors import SimulationDiverged
from .simulation.actuation import Waveform, read_pressure_csv, square_wave
from .simulation.contact import Plane, ground
from .simulation.loads import Chain, Clamp, Drag, Force, PointMass, QuadraticDrag, Spring
from .simulation.material import Body, Gas, Prony, Solid
from .simulation.runtime import init
from .simulation.simulator import Simulator
from .simulation.stability import stable_step
from .simulation.trajectory import Start, Trajectory

__version__: str
__all__ = [
    "AugmentedLagrangian",
    "Body",
    "Chain",
    "Chamber",
    "Clamp",
    "DesignField",
    "Domain",
    "Drag",
    "Force",
    "Gas",
    "Plane",
    "Plateau",
    "PointMass",
    "Prony",
    "QuadraticDrag",
    "Region",
    "SimulationDiverged",
    "Simulator",
    "Solid",
    "Spring",
    "Start",
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
