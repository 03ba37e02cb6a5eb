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

# Per-plane numbers: offset along its axis or normal, Coulomb coefficient, adhesive traction and its reach, unit normal
# (three); and its integers: the normal counts with the sign, and the axis is of the updated form.
PLANE_OFFSET, PLANE_FRICTION, PLANE_ADHESION, PLANE_REACH, PLANE_NORMAL = 0, 1, 2, 3, 4
PLANE = 7
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
    *("faced", "ties", "pushes", "wall_chunks"),
)
BATCH, NX, NY, NZ, MX, MY, MZ, TX, TY, TZ, ELEMENTS, CHAMBERS, GROUPS, SPRINGS = range(2, 16)
VISCOUS, PLANES, SLOTS, RING, KEPT_RING, STEPS, WANT_PRONY, TALLIES, BLOCKS, HISTORIES = range(16, 26)
FACED, TIES, PUSHES, WALL_CHUNKS = range(26, 30)

# What a kernel is compiled for, a sum of these: forces on points, springs or viscosity; solids that stiffen, that
# soften; quadratic drag; springs to mean displacements; forces on nodes; hollow chambers.
LOADED, STIFFENS, SOFTENS, IMMERSED, TIED, PUSHED_NODES, HOLLOW = (2**n for n in range(7))

# Buffer by buffer, in order, what lies in it: integers; what stays the same in a segment; what acts over time; what is
# kept of every substep beside the states; what points and nodes hand each other, forward and (from FORCES) backward;
# sums of gradients.
BUFFERS = {
    "integers": (
        *("kind", "plane_kind", "firsts", "tiles", "chamber_start", "slot_start", "slot_chamber", "sources"),
        *("near_nodes", "wall_chunk", "wall_kind", "wall_start", "wall_entry"),
    ),
    "fixed": (
        *("numbers", "coefficients", "prony", "plane_numbers", "nodal", "chamber", "share", "areas", "softening"),
        *("quadratic", "tie_share", "ties", "node_share", "walls", "wall_weights"),
    ),
    "supply": ("pressure", "gravity", "force"),
    "kept": ("volumes", "pushed"),
    "scratch": ("partials", "swept", "pads", "tension", "normals"),
    "backward": ("forces", "surfaces", "volume_bar", "jacobians"),
    "sums": tuple(
        f"{name}_bar"
        for name in (
            *("coefficients", "prony", "pressure", "gravity", "force", "plane_numbers", "nodal", "chamber"),
            *("softening", "quadratic", "ties"),
        )
    ),
}
KIND, PLANE_KIND, FIRSTS, TILES, CHAMBER_START, SLOT_START, SLOT_CHAMBER, SOURCES, NEAR_NODES = range(30, 39)
WALL_CHUNK, WALL_KIND, WALL_START, WALL_ENTRY = range(39, 43)
NUMBERS, COEFFICIENT, ELEMENT, PLANE_NUMBERS, NODES, CHAMBER_NUMBERS, SHARE, AREA, SOFTENING = range(43, 52)
QUADRATIC, TIE_SHARE, TIE_STIFFNESS, NODE_SHARE, WALL_NUMBERS, WALL_WEIGHTS = range(52, 58)
PRESSURE, GRAVITY, FORCE = range(58, 61)
VOLUMES, PUSHED = range(61, 63)
PARTIALS, SWEPT, PADS, TENSION, NORMALS = range(63, 68)
FORCES, SURFACES, VOLUME_BAR, JACOBIANS = range(68, 72)
COEFFICIENT_BAR, ELEMENT_BAR, PRESSURE_BAR, GRAVITY_BAR, FORCE_BAR, PLANE_BAR, NODES_BAR, CHAMBER_BAR = range(72, 80)
SOFTENING_BAR, QUADRATIC_BAR, TIES_BAR = range(80, 83)
HEAD = 83

# A point of a hollow chamber's wall: its lowest node, chamber and axis; place (three), area, and then of each of its 27
# nodes the weight and two slopes; what it hands to its nodes at most: five vectors.
WALL_INTEGERS = 3
WALL = 4 + 3 * 27
WALL_VECTORS = 15

# Numbers of the lattice: substep, edge of a cell for contact; then the axes one after the other: for each point the
# weights of its three nodes and their slopes by the reference place; places of the particles; places of the nodes.
STEP_SIZE, EDGE, AXES = 0, 1, 2
AXIS = 6

# A tile is a box of seats for cells whose points a block of threads works on, one each. Its nodes are two more along
# each axis than its seats, of which one stays free where a crease crosses the tile. A node belongs to two tiles along
# each axis at most.
TILE_CELLS = (2, 4, 4)
TILE = 256  # points of a tile
TILE_X, TILE_Y, TILE_Z = (n + 2 for n in TILE_CELLS)  # nodes
TILE_NODES = TILE_X * TILE_Y * TILE_Z
TILE_LINES = 2 * TILE_CELLS[0] * 2 * TILE_CELLS[1] * TILE_Z
TILE_SHEETS = 2 * TILE_CELLS[0] * TILE_Y * TILE_Z
SHARED = 8  # tiles that a node belongs to
# What a tile hands to one of its nodes: its share of a force, by all its points or by those of a chamber (a "slot").
SLOT = 3 * TILE_NODES

# A node's mass, the way from it to the surface of the matter that it carries, in cells, and its drag factor: the share
# of its velocity that implicit drag leaves in a substep.
NODAL_MASS, NODAL_REACH, NODAL_DRAG_FACTOR = 0, 1, 4
NODAL = 5

# What a point hands to the nodes: a tensor that goes with the slopes and a vector that goes with the weights; the same
# after the sum along z: three vectors, for slopes along x, y and z; after the sum along y: for slopes along x and not.
BUNDLE = 12
LINE = 9
SHEET = 6
# Numbers that a tile shares: of its points, and then of its sheets; of its lines, and before of a third vector at its
# nodes; two vectors at its nodes; of the axes.
PAD_POINTS, PAD_LINES = 0, BUNDLE * TILE
PAD_NODES = PAD_LINES + LINE * TILE_LINES
PAD_AXES = PAD_NODES + 2 * SLOT
PAD = PAD_AXES + AXIS * 2 * sum(TILE_CELLS)

# A chamber: mean air stiffness, reference volume.
CHAMBER_STIFFNESS, CHAMBER_VOLUME = 0, 1
CHAMBER = 2
ABSENT = -2  # kind of a lattice place without a particle
