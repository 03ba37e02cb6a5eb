"""Where each quantity lies in the flat buffers that kernels and ops share.

Particle buffers are structures of arrays: component ``c`` of particle ``p`` of simulation ``b`` in slot ``r`` of a ring
lies at ``((r * batch + b) * components + c) * particles + p``. Node buffers keep a node's components together.
"""

# State: position, velocity, affine velocity C, deformation gradient F (a gas keeps J in F[0, 0]), then one symmetric
# history tensor H (xx, yy, zz, xy, yz, xz) for every Maxwell element.
POSITION, VELOCITY, AFFINE, DEFORMATION, HISTORY = 0, 3, 6, 15, 24


def state_components(elements: int) -> int:
    """Number of state components of a particle with so many Maxwell elements."""
    return HISTORY + 6 * elements


# Per-particle coefficients.
MASS, VOLUME, BULK, SHEAR, VISCOSITY, VOLUME_VISCOSITY, SPRING, ANCHOR, DRAG, VOID_FRACTION = (
    0,
    1,
    2,
    3,
    4,
    5,
    6,
    7,
    10,
    11,
)
STIFFENING = 12  # two of them: by I1b - 3 and by its square
COEFFICIENTS = 14

# Per-element numbers of the exact-exponential history update: decay a, gain b, modulus g relative to equilibrium.
PRONY_DECAY, PRONY_GAIN, PRONY_MODULUS = 0, 1, 2
PRONY = 3

# Per-plane numbers: offset along its axis, Coulomb coefficient, adhesive traction; and its integers.
PLANE_OFFSET, PLANE_FRICTION, PLANE_ADHESION = 0, 1, 2
PLANE = 3
PLANE_AXIS, PLANE_SIGN, PLANE_STICK = 0, 1, 2

# Nodes: mass and velocity with internal forces (kept for the adjoint); affine FLIP also needs, in a buffer of its own,
# the velocity before any force; then the velocity after contact and the transferred one.
NODE_MASS, NODE_VELOCITY = 0, 1
NODE = 4
BEFORE = 3
NODE_MOVED, NODE_TRANSFER = 0, 3
NODE_NEW = 6

# Adjoint of a node: of (moved + transferred) velocity, and of the FLIP part of the transferred one.
ADJOINT_MOVED, ADJOINT_FLIP = 0, 3
ADJOINT_NEW = 6

# What a substep flags; the march then repeats the chunk step by step to say where.
FLAG_LEFT_BOX, FLAG_COLLAPSED = 0, 1

# The total-Lagrangian form. Its state, one flat vector for each simulation: displacement and velocity of the nodes,
# component by component; then 6 numbers Z for every Maxwell element of every point, component by component.
# Z = H - b S needs no stress of the substep before: H' = a H + b (S' - S) is Z' = a Z - b (1 - a) S.


def lattice_components(nodes: int, points: int, elements: int) -> int:
    """Length of that vector."""
    return 6 * nodes + 6 * elements * points


# Its kernels take few buffers, since each costs a microsecond a launch on a GPU. The integers begin with the clock
# (substep, where to stop, whether the last pass did anything, first substep at which a solid collapsed), sizes, and
# where each quantity begins in its buffer.
NOW, STOP, ACTIVE, COLLAPSED = 0, 1, 2, 3
SIZES = (
    *("batch", "nx", "ny", "nz", "elements", "chambers", "groups", "springs", "viscous", "planes"),
    *("ring", "kept_ring", "steps", "want_prony", "tallies"),
)
BATCH, NX, NY, NZ, ELEMENTS, CHAMBERS, GROUPS, SPRINGS, VISCOUS, PLANES = range(4, 14)
RING, KEPT_RING, STEPS, WANT_PRONY, TALLIES = range(14, 19)

# Buffer by buffer, in order, what lies in it: integers; what stays the same in a segment; what acts over time; what is
# kept of every substep beside the states; what points and nodes hand each other, forward and (from FORCES) backward;
# sums of gradients.
BUFFERS = {
    "integers": ("kind", "plane_kind", "corner", "rank", "filled", "near_lines", "near_sheets", "near_nodes"),
    "fixed": ("numbers", "coefficients", "prony", "plane_numbers", "nodal", "chamber", "share"),
    "supply": ("pressure", "gravity", "force"),
    "kept": ("volumes", "pushed"),
    "scratch": ("points", "lines", "sheets", "area", "area_lines", "area_sheets", "swept", "parts", "groups"),
    "backward": ("forces", "surfaces", "rates", "rate_lines", "rate_sheets", "volume_bar", "jacobians"),
    "sums": tuple(
        f"{name}_bar"
        for name in ("coefficients", "prony", "pressure", "gravity", "force", "plane_numbers", "nodal", "chamber")
    ),
}
KIND, PLANE_KIND, POINT_CORNER, RANK, FILLED, NEAR_LINES, NEAR_SHEETS, NEAR_NODES = range(19, 27)
NUMBERS, COEFFICIENT, ELEMENT, PLANE_NUMBERS, NODES, CHAMBER_NUMBERS, SHARE = range(27, 34)
PRESSURE, GRAVITY, FORCE = range(34, 37)
VOLUMES, PUSHED = range(37, 39)
POINT_SUM, LINE_SUM, SHEET_SUM, AREA, AREA_LINES, AREA_SHEETS, SWEPT, PART_SUM, GROUP_SUM = range(39, 48)
FORCES, SURFACES, RATES, RATE_LINES, RATE_SHEETS, VOLUME_BAR, JACOBIANS = range(48, 55)
COEFFICIENT_BAR, ELEMENT_BAR, PRESSURE_BAR, GRAVITY_BAR, FORCE_BAR, PLANE_BAR, NODES_BAR, CHAMBER_BAR = range(55, 63)
HEAD = 63

# Numbers of the lattice: substep, cell, lower corner of the body; the weights of the three nodes per axis for the
# first and the second point of a cell, and their slopes by the reference place.
STEP_SIZE, EDGE, CORNER, WEIGHT, SLOPE = 0, 1, 2, 5, 11
LATTICE_NUMBERS = 17

# A node's mass, the way from it to the surface of the matter that it carries, in cells, and its drag factor: the share
# of its velocity that implicit drag leaves in a substep.
NODAL_MASS, NODAL_REACH, NODAL_DRAG_FACTOR = 0, 1, 4
NODAL = 5

# What a point hands to the nodes: a tensor that goes with the slopes and a vector that goes with the weights; the same
# after the sum along z: three vectors, for slopes along x, y and z; after the sum along y: for slopes along x and not.
BUNDLE = 12
LINE = 9
SHEET = 6

# A chamber: mean air stiffness, reference volume.
CHAMBER_STIFFNESS, CHAMBER_VOLUME = 0, 1
CHAMBER = 2
# A sum over a chamber's points is taken in parts, these in groups, and these by whoever needs the sum.
CHAMBER_GROUPS = 32
CHAMBER_PARTS = 32 * CHAMBER_GROUPS

ABSENT = -2  # kind of a lattice place without a particle
