"""Names, numbers and units as people write them: of effects, of their quantities, of measurement errors."""

from __future__ import annotations

import math

# Effects of the library as noun phrases; an effect of one's own is called by its name.
EFFECTS = {
    "viscoelastic": "viscous damping of the material (a Maxwell element)",
    "modulus": "another Young's modulus",
    "stiffening": "stiffening of the material at large strain",
    "softening": "softening of the material after large strain (Mullins effect)",
    "soft_side": "a softer side of the body",
    "print_offset": "a chamber that lies off its place",
    "density": "another density",
    "attached_mass": "an attached mass",
    "load_inertia": "the inertia of a load",
    "tether": "a tether (at one place a spring, a damper and a mass, a steady pull, or a tube that hangs there)",
    "drag": "drag of the surrounding fluid",
    "pressure_lag": "a lag of the chamber pressure",
    "pressure_loss": "another chamber pressure than supplied",
    "leak": "a leak of the pressure line",
    "air_stiffness": "another compressibility of the chamber's air",
    "friction": "another friction of the planes",
    "adhesion": "adhesion to the planes",
    "wall_offset": "another place of the planes",
    "gravity_tilt": "a tilted setup",
    "initial_motion": "another velocity at the start",
    "initial_tilt": "another orientation at the start",
    "initial_pose": "a bend from which the body was let go",
}

# Quantities by name, or by effect and name where one name means several things.
QUANTITIES = {
    "modulus.factor": "factor on the stated modulus",
    "density.factor": "factor on the stated density",
    "modulus_over_equilibrium": "modulus of the element over the stated one",
    "time_s": "relaxation time",
    "viscosity_pa_s": "viscosity",
    "stiffening.coefficient": "stiffening coefficient",
    "depth": "largest loss of stress",
    "ln_range": "strain measure (I1 - 3) over which the loss grows",
    "soft_side.fraction": "modulus that the soft part lacks",
    "slope_x": "rise of ln E across the body along x",
    "slope_y": "rise of ln E across the body along y",
    "slope_z": "rise of ln E across the body along z",
    "boundary": "where the softer part ends, off the middle",
    "contrast_x": "rise of ln E from one part to the other along x",
    "contrast_y": "rise of ln E from one part to the other along y",
    "contrast_z": "rise of ln E from one part to the other along z",
    "offset_first_m": "offset along the first axis across the body",
    "offset_second_m": "offset along the second axis across the body",
    "mass_kg": "mass",
    "load_inertia.share": "share of the load that is a mass",
    "stiffness_n_m": "stiffness",
    "damping_n_s_m": "coefficient of the damper",
    "pull_x": "pull along x",
    "pull_y": "pull along y",
    "pull_z": "pull along z",
    "pull_n": "pull",
    "fraction": "pressure lost",
    "fraction_at_highest": "pressure lost at the highest pressure",
    "time_constant_s": "time constant",
    "air_stiffness_pa": "pressure lost as the chamber doubles its volume",
    "density_drag_kg_m3": "density of the fluid times drag coefficient",
    "coefficient": "friction coefficient",
    "traction": "adhesive traction",
    "reach_m": "reach of the adhesion",
    "energy_j_m2": "energy of separation",
    "offset_m": "offset towards the body",
    "about_first": "tilt about the first axis normal to gravity",
    "about_second": "tilt about the second axis normal to gravity",
    "about_x": "tilt about x",
    "about_y": "tilt about y",
    "about_z": "tilt about z",
    "angle_rad": "angle",
    "speed_m_s": "speed",
    "deflection_m": "deflection of the free end",
    "tube_mass_kg": "mass of the tube",
    "tube_length_m": "length of the tube",
    "initial_pose.offset_first_m": "deflection along the first axis across the body",
    "initial_pose.offset_second_m": "deflection along the second axis across the body",
    "velocity_x": "velocity along x",
    "velocity_y": "velocity along y",
    "velocity_z": "velocity along z",
    "spin_x": "rate of turn about x",
    "spin_y": "rate of turn about y",
    "spin_z": "rate of turn about z",
    "ln_factor": "relative change",
}

# Of effects with more numbers than a sentence bears, those that it holds.
MAIN = {
    "viscoelastic": ("viscosity_pa_s", "time_s"),
    "soft_side": ("fraction",),
    "tether": ("mass_kg", "stiffness_n_m", "damping_n_s_m", "pull_n"),
    "gravity_tilt": ("angle_rad",),
    "initial_motion": ("speed_m_s",),
    "initial_tilt": ("angle_rad",),
    "initial_pose": ("deflection_m",),
    "adhesion": ("energy_j_m2",),
}

PERCENT = {"fraction", "fraction_at_highest", "depth", "share"}  # quantities of unit 1 that people state in percent

# Units people use: factor on the SI value, and name; the first row whose upper limit is above the value.
_UNITS = {
    "m": ((1e-4, 1e6, "µm"), (math.inf, 1e3, "mm")),
    "s": ((1.0, 1e3, "ms"), (math.inf, 1.0, "s")),
    "m/s": ((0.1, 1e3, "mm/s"), (math.inf, 1.0, "m/s")),
    "kg": ((1.0, 1e3, "g"), (math.inf, 1.0, "kg")),
    "Pa": ((1e3, 1.0, "Pa"), (1e6, 1e-3, "kPa"), (math.inf, 1e-6, "MPa")),
    "rad": ((math.inf, math.degrees(1.0), "°"),),
    "rad/s": ((math.inf, math.degrees(1.0), "°/s"),),
    "N": ((1.0, 1e3, "mN"), (math.inf, 1.0, "N")),
    "N/m": ((1e3, 1.0, "N/m"), (math.inf, 1e-3, "kN/m")),
    "N s/m": ((1.0, 1e3, "mN s/m"), (math.inf, 1.0, "N s/m")),
    "Pa s": ((1.0, 1e3, "mPa s"), (1e3, 1.0, "Pa s"), (math.inf, 1e-3, "kPa s")),
    "J/m2": ((1.0, 1e3, "mJ/m²"), (math.inf, 1.0, "J/m²")),
    "kg/m3": ((math.inf, 1.0, "kg/m³"),),
    "1": ((math.inf, 1.0, ""),),
    "over the body": ((math.inf, 1.0, ""),),
    "between parts": ((math.inf, 1.0, ""),),
    "of the body": ((math.inf, 100.0, "% of the body"),),
}


def effect_words(name: str) -> str:
    """An effect, or several joined by " + ", as a phrase."""
    return " and ".join(EFFECTS.get(part, part.replace("_", " ")) for part in name.split(" + "))


def quantity_words(effect: str, name: str) -> str:
    """A quantity of an effect as a phrase."""
    return QUANTITIES.get(f"{effect}.{name}", QUANTITIES.get(name, name.replace("_", " ")))


def digits(value: float) -> str:
    """Three significant digits, without an exponent where that is legible."""
    if value == 0 or not math.isfinite(value) or not 1e-4 <= abs(value) < 1e7:
        return f"{value:.3g}"
    places = max(2 - math.floor(math.log10(abs(value))), 0)
    text = f"{round(value, 2 - math.floor(math.log10(abs(value)))):.{places}f}"
    return text.rstrip("0").rstrip(".") if "." in text else text


def in_units(values: tuple[float, ...], unit: str, name: str = "") -> tuple[list[str], str]:
    """Numbers and the unit that suits the first of them.

    Args:
        values: In SI units, or their logarithm where the unit begins with "ln".
        unit: As in explanation.json.
        name: Of the quantity.
    """
    if unit.startswith("ln "):
        values, unit = tuple(math.exp(min(v, 700.0)) for v in values), unit.removeprefix("ln ")
        unit = unit if unit in _UNITS else "1"
    if name == "ln_factor":
        return [digits(100 * math.expm1(v)) for v in values], "%"
    if name in PERCENT and unit == "1":
        return [digits(100 * v) for v in values], "%"
    limits = _UNITS.get(unit, ((math.inf, 1.0, unit),))
    _, factor, suffix = next(row for row in limits if abs(values[0]) < row[0] or row[0] == math.inf)
    return [digits(factor * v) for v in values], suffix


def with_unit(value: float, unit: str, name: str = "") -> str:
    """A number with its unit."""
    (number,), suffix = in_units((value,), unit, name)
    return number + ("" if suffix in ("", "°", "°/s") else " ") + suffix


def interval(value: float, low: float, high: float, unit: str, name: str = "") -> str:
    """An interval in the unit that suits its value, or its larger end where that is zero."""
    suited = value if value or unit.startswith("ln ") else max(low, high, key=abs)
    (_, one, other), suffix = in_units((suited, low, high), unit, name)
    return f"{one} to {other}" + ("" if suffix in ("", "°", "°/s") else " ") + suffix


def error_words(name: str) -> tuple[str, str]:
    """A measurement error, or a number of the setup that is fitted always: as a phrase, and its unit."""
    relative = {
        "ln_modulus": "Young's modulus",
        "ln_pressure": "pressure",
        "ln_friction": "coefficient of friction",
        "ln_scale": "scale of lengths",
    }
    if name in relative:
        return relative[name], "%"
    if name == "clock_rate":
        return "rate of the clock", "%"
    if name.startswith("clock_"):
        return f"clock of trial {name.removeprefix('clock_').removesuffix('_s')}", "s"
    if name.startswith("rotation_"):
        return f"rotation of the frame about {name[9]}", "rad"
    if name.startswith("slip_"):
        return f"slip of a marker, {name.removeprefix('slip_').removesuffix('_m').replace('_', ' ')}", "m"
    marker, axis, _ = name.rsplit("_", 2)
    return f"place of marker {marker} along {axis}", "m"


def error_number(value: float, unit: str) -> str:
    """A measurement error with its unit; a relative one in percent."""
    return f"{digits(100 * value)} %" if unit == "%" else with_unit(value, unit)


def millimetres(value: float) -> str:
    """A length in mm however small it is, so that several can be compared."""
    return f"{digits(1e3 * value)} mm"


def probability(value: float) -> str:
    """In percent; of what is nearly sure or nearly excluded, on which side of that it is."""
    if value > 0.999:
        return "above 99.9 %"
    return f"{100 * value:.1f} %" if value >= 0.001 else "below 0.1 %"
