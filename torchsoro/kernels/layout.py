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
MASS, VOLUME, BULK, SHEAR, VISCOSITY, VOLUME_VISCOSITY, SPRING, ANCHOR, DRAG = 0, 1, 2, 3, 4, 5, 6, 7, 10
COEFFICIENTS = 11

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
