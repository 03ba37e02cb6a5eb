"""Where each quantity lies in the flat buffers that kernels and ops share.

Particle buffers are structures of arrays: component ``c`` of particle ``p`` of simulation ``b`` in slot ``r`` of a ring
lies at ``((r * batch + b) * components + c) * particles + p``. Node buffers keep a node's components together.
"""

from typing import NamedTuple

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
AIR_SHARE, AIR_STIFFNESS = 14, 15  # of a solid that encloses air of a chamber: share of its volume, and that air's k
COEFFICIENTS = 16

# Per-element numbers of the exact-exponential history update: decay a, gain b, modulus g relative to equilibrium.
PRONY_DECAY, PRONY_GAIN, PRONY_MODULUS = 0, 1, 2
PRONY = 3

# Per-plane numbers: offset along its axis or normal, Coulomb coefficient, adhesive traction and its reach, unit normal
# (three), what is added to the coefficient at rest and the speed that halves it; and its integers: the normal counts
# with the sign, and the axis is of the updated form.
PLANE_OFFSET, PLANE_FRICTION, PLANE_ADHESION, PLANE_REACH, PLANE_NORMAL, PLANE_AT_REST, PLANE_SLOW = 0, 1, 2, 3, 4, 7, 8
PLANE = 9
PLANE_AXIS, PLANE_SIGN, PLANE_STICK, PLANE_ELASTIC = 0, 1, 2, 3
PLANE_INTEGERS = 4

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

LARGEST = 2**31 - 1  # numbers in a buffer, which kernels index with 32 bits

# The clock of the updated form: substep, and whether the last pass did anything.
NOW, ACTIVE = 0, 2

# What a substep flags; the march then repeats the chunk step by step to say where.
FLAG_LEFT_BOX, FLAG_COLLAPSED = 0, 1

# The total-Lagrangian form. Its state, one flat vector for each simulation: displacement and velocity of the nodes,
# component by component; then 6 numbers Z for every Maxwell element of every point, component by component; then, where
# solids soften, the largest I1b - 3 of every point so far.
# Z = H - b S needs no stress of the substep before: H' = a H + b (S' - S) is Z' = a Z - b (1 - a) S.


def lattice_components(nodes: int, points: int, elements: int, softens: bool = False) -> int:
    """Length of that vector."""
    return 6 * nodes + (6 * elements + softens) * points


# Its kernels take few buffers. The integers begin with what kernels change (first substep at which a solid collapsed;
# how often blocks have arrived at a barrier), sizes, and where each quantity begins in its buffer.
COLLAPSED, ARRIVED = 0, 1
SIZES = (
    *("batch", "nx", "ny", "nz", "mx", "my", "mz", "tx", "ty", "tz", "elements", "chambers", "groups", "springs"),
    *("viscous", "planes", "slots", "ring", "kept_ring", "steps", "want_prony", "tallies", "blocks", "histories"),
    *("faced", "ties", "pushes", "wall_chunks", "wall_rows", "fluid", "watched", "sample_at", "row_at", "chain_steps"),
)
BATCH, NX, NY, NZ, MX, MY, MZ, TX, TY, TZ, ELEMENTS, CHAMBERS, GROUPS, SPRINGS = range(2, 16)
VISCOUS, PLANES, SLOTS, RING, KEPT_RING, STEPS, WANT_PRONY, TALLIES, BLOCKS, HISTORIES = range(16, 26)
FACED, TIES, PUSHES, WALL_CHUNKS, WALL_ROWS, FLUID, WATCHED, SAMPLE_AT, ROW_AT, CHAIN_STEPS = range(26, 36)

# What a kernel is compiled for, a sum of these: forces on points, springs or viscosity; solids that stiffen, that
# soften; quadratic drag; springs to mean displacements; forces on nodes; hollow chambers; nodes whose motion is
# recorded at samples; solids that have shares of the chambers' air; contact of a body with itself.
LOADED, STIFFENS, SOFTENS, IMMERSED, TIED, PUSHED_NODES, HOLLOW, RECORDED = (2**n for n in range(8))
SHARED_AIR, REPELLED = 2**8, 2**9
# All loads and laws, for variations that have now one and now another.
ANY_LOAD = LOADED + STIFFENS + SOFTENS + IMMERSED + TIED + PUSHED_NODES

# Buffer by buffer, in order, what lies in it: integers; what stays the same in a segment; what acts over time; what is
# kept of every substep beside the states, and the motion of nodes at samples; what points and nodes hand each other,
# forward and (from FORCES) backward; sums of gradients.
BUFFERS = {
    "integers": (
        *("kind", "plane_kind", "firsts", "tiles", "chamber_start", "slot_start", "slot_chamber", "sources"),
        *("near_nodes", "wall_chunk", "wall_kind", "wall_row", "wall_count", "wall_entry", "near_number"),
    ),
    "fixed": (
        *("numbers", "coefficients", "prony", "plane_numbers", "nodal", "chamber", "share", "areas", "softening"),
        *("quadratic", "tie_share", "ties", "node_share", "walls", "wall_weights", "tile_axes", "chains"),
    ),
    "supply": ("pressure", "gravity", "force"),
    "kept": ("volumes", "pushed", "seen"),
    "scratch": ("partials", "swept", "pads", "tension", "normals", "repulsion", "beads"),
    "backward": ("forces", "surfaces", "volume_bar", "jacobians"),
    "sums": tuple(
        f"{name}_bar"
        for name in (
            *("coefficients", "prony", "pressure", "gravity", "force", "plane_numbers", "nodal", "chamber"),
            *("softening", "quadratic", "ties"),
        )
    ),
}
KIND, PLANE_KIND, FIRSTS, TILES, CHAMBER_START, SLOT_START, SLOT_CHAMBER, SOURCES, NEAR_NODES = range(36, 45)
WALL_CHUNK, WALL_KIND, WALL_ROW, WALL_COUNT, WALL_ENTRY, NEAR_NUMBER = range(45, 51)
NUMBERS, COEFFICIENT, ELEMENT, PLANE_NUMBERS, NODES, CHAMBER_NUMBERS, SHARE, AREA, SOFTENING = range(51, 60)
QUADRATIC, TIE_SHARE, TIE_STIFFNESS, NODE_SHARE, WALL_NUMBERS, WALL_WEIGHTS, TILE_AXES, CHAINS = range(60, 68)
PRESSURE, GRAVITY, FORCE = range(68, 71)
VOLUMES, PUSHED, SEEN = range(71, 74)
PARTIALS, SWEPT, PADS, TENSION, NORMALS, REPULSION, BEADS = range(74, 81)
FORCES, SURFACES, VOLUME_BAR, JACOBIANS = range(81, 85)
COEFFICIENT_BAR, ELEMENT_BAR, PRESSURE_BAR, GRAVITY_BAR, FORCE_BAR, PLANE_BAR, NODES_BAR, CHAMBER_BAR = range(85, 93)
SOFTENING_BAR, QUADRATIC_BAR, TIES_BAR = range(93, 96)
HEAD = 96

# A hanging chain: beads; its numbers: fixed end, rest length, stiffness and damping of a link, one over the mass of a
# bead, where beads are at first; and its state: places of beads, their velocities, where the end on the body was.
CHAIN_BEADS = 4
CHAIN_REST, CHAIN_STIFFNESS, CHAIN_DAMPING, CHAIN_LIGHTNESS, CHAIN_START = 3, 4, 5, 6, 7
CHAIN = CHAIN_START + 3 * CHAIN_BEADS
CHAIN_STATE = 6 * CHAIN_BEADS + 3

# A point of a hollow chamber's wall: its lowest node, chamber and axis; place (three), area, and then of each of its 27
# nodes the weight and two slopes; what it hands to its nodes at most: five vectors. Number by number, so that threads
# that work on neighbours read what lies together; so do what nodes near walls add up, the first of all of them, then
# the second, ...
WALL_INTEGERS = 3
WALL = 4 + 3 * 27
WALL_VECTORS = 15

# Numbers of the lattice: substep, edge of a cell for contact; then the axes one after the other: for each point the
# weights of its three nodes and their slopes by the reference place; places of the particles; places of the nodes.
STEP_SIZE, EDGE, AXES = 0, 1, 2
AXIS = 6

# What a point hands to the nodes: a tensor that goes with the slopes and a vector that goes with the weights; the same
# after the sum along z: three vectors, for slopes along x, y and z.
BUNDLE = 12
LINE = 9
TILE = 256  # points of a tile at most, and threads that work on them, one each
# Numbers of a point along an axis that a tile shares; the last is the lowest node of its cell, in the tile.
PAD_AXIS = AXIS + 1
SHARED = 8  # tiles that a node belongs to


class Shape(NamedTuple):
    """How many cells and nodes a tile has along each axis at most; more than two nodes beyond its cells for creases.

    Points, lines of them along z, sheets of lines and nodes are at most ``TILE`` each.
    """

    cells: tuple[int, int, int]
    nodes: tuple[int, int, int]

    @property
    def wide(self) -> int:
        """Points along x."""
        return 2 * self.cells[0]

    @property
    def deep(self) -> int:
        """Points along y."""
        return 2 * self.cells[1]

    @property
    def high(self) -> int:
        """Points along z."""
        return 2 * self.cells[2]

    @property
    def layer(self) -> int:
        """Nodes across x."""
        return self.nodes[1] * self.nodes[2]

    @property
    def count(self) -> int:
        """Nodes in all."""
        return self.nodes[0] * self.layer

    @property
    def lines(self) -> int:
        """Sums along z."""
        return self.wide * self.deep * self.nodes[2]

    @property
    def sheets(self) -> int:
        """Sums along z and y."""
        return self.wide * self.layer

    @property
    def slot(self) -> int:
        """What a tile hands to its nodes: its share of a force, by all its points or by those of a chamber."""
        return 3 * self.count

    # Numbers that a tile shares: of its points, and then of its sheets; of its lines, and before of a third vector at
    # its nodes; two vectors at its nodes; of the axes.
    @property
    def pad_nodes(self) -> int:
        """Where vectors at the nodes begin."""
        return PAD_LINES + LINE * self.lines

    def along(self, axis: int) -> int:
        """What is to be known of points and nodes along an axis."""
        return PAD_AXIS * 2 * self.cells[axis] + self.nodes[axis]

    def axis_at(self, axis: int) -> int:
        """Where weights and slopes of the points along an axis begin."""
        return self.pad_nodes + 2 * self.slot + sum(map(self.along, range(axis)))

    def cells_at(self, axis: int) -> int:
        """Where, for nodes along an axis, the number of the cell begins of which each is the lowest; -1 for none."""
        return self.axis_at(axis) + PAD_AXIS * 2 * self.cells[axis]

    @property
    def pad(self) -> int:
        """All numbers that a tile shares."""
        return self.axis_at(3)


PAD_LINES = BUNDLE * TILE
# For bodies without creases; across two creases; for bodies of a few cells across, and for slender ones.
SHAPES = (
    Shape((2, 4, 4), (4, 6, 6)),
    Shape((2, 4, 4), (4, 8, 8)),
    Shape((3, 3, 3), (6, 6, 6)),
    Shape((2, 5, 3), (4, 8, 6)),
    Shape((2, 3, 5), (4, 6, 8)),
    Shape((8, 2, 2), (10, 4, 4)),
)

# A node's mass, the way from it to the surface of the matter that it carries, in cells, and its drag factor: the share
# of its velocity that implicit drag leaves in a substep.
NODAL_MASS, NODAL_REACH, NODAL_DRAG_FACTOR = 0, 1, 4
NODAL = 5

# A chamber: mean air stiffness, reference volume.
CHAMBER_STIFFNESS, CHAMBER_VOLUME = 0, 1
CHAMBER = 2
ABSENT = -2  # kind of a lattice place without a particle
ENCLOSES = -3  # kind of a solid of which a share is air of the first chamber; -4 of the second, and so on
