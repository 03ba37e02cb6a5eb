"""Numbers of up to sixteen variations of a body, as they differ between lanes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Case(NamedTuple):
    """What differs between lanes, and what acts on them; SI units.

    Attributes:
        dt: Substep.
        steps: Of them.
        every: Substeps between two samples.
        own: Of each point, eight to a cell with z fastest, shear and bulk modulus times volume, and 0 [P * 48].
        series: Of Maxwell elements g, g b, a and b (1 - a) [E * 64], with a and b as in ``Prony.discrete``.
        law: Coefficients a and b of ``stress.stiffening``, depth and range of softening [64].
        stiffens: Whether any of the former is not zero.
        softens: Whether any depth is not zero.
        weight: One over the mass of nodes [n, 16]; 0 for those without.
        left: What drag leaves of a node's velocity in a substep [n, 16].
        gravity: [3, 16].
        fluid: Half the density of the fluid around times its drag coefficient [16].
        place: Displacement of nodes at the start [n, 3, 16].
        velocity: Of nodes at the start [n, 3, 16].
        supply: Pressure of chambers at each substep [steps, chambers, 16].
        air: Stiffness of the air in chambers [chambers, 16].
        volume: Of the undeformed chambers [chambers].
        push_begin: First entry of each force, and the end [G + 1].
        push_node: Node of each entry.
        push_share: Its share of the force.
        push: Forces [G, 3, 16].
        push_start: Substep at which they begin [G].
        spring_node: Nodes of springs [R].
        spring_share: Of each, for each lane [R, 16].
        spring_number: Number of the spring [R].
        springs: Stiffness of springs [Q, 16].
        normals: Of planes [A, 3].
        stick: Whether planes hold what is pressed on them [A].
        offset: Of planes along their normals [A, 16].
        friction: Coulomb coefficients [A, 16].
        adhesion: Tractions that pull towards planes [A, 16].
        reach: So far [A, 16].
        area: Of nodes that face planes [A, n].
    """

    dt: float
    steps: int
    every: int
    own: np.ndarray
    series: np.ndarray
    law: np.ndarray
    stiffens: bool
    softens: bool
    weight: np.ndarray
    left: np.ndarray
    gravity: np.ndarray
    fluid: np.ndarray
    place: np.ndarray
    velocity: np.ndarray
    supply: np.ndarray
    air: np.ndarray
    volume: np.ndarray
    push_begin: np.ndarray
    push_node: np.ndarray
    push_share: np.ndarray
    push: np.ndarray
    push_start: np.ndarray
    spring_node: np.ndarray
    spring_share: np.ndarray
    spring_number: np.ndarray
    springs: np.ndarray
    normals: np.ndarray
    stick: np.ndarray
    offset: np.ndarray
    friction: np.ndarray
    adhesion: np.ndarray
    reach: np.ndarray
    area: np.ndarray
