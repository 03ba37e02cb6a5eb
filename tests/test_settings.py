"""Settings and the command line made of them: presets, overrides, and what is refused."""

from __future__ import annotations

import dataclasses
import math
import typing
from typing import Any

import numpy as np
import pytest
import torch
from tiny import TINY

from torchsoro import SimulationDiverged
from torchsoro.command_line import plain_errors
from torchsoro.design.presets import CLIMBER, WALKER
from torchsoro.design.reading import from_command_line
from torchsoro.design.settings import Settings

PRESETS = {"desk": dataclasses.replace(TINY, device="auto"), "paper": Settings()}


def parse(*arguments: str) -> Settings:
    return from_command_line(PRESETS, description="Design.", arguments=arguments)


def test_the_preset_follows_the_device_unless_it_is_named(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert parse() == PRESETS["desk"]
    assert parse("--preset", "paper") == PRESETS["paper"]
    assert parse("--device", "cpu").target == torch.device("cpu")
    assert parse().target == torch.device("cpu")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert parse() == PRESETS["paper"]
    assert parse().target == torch.device("cuda")
    assert parse("--preset=desk").preset == "desk"
    assert parse("--device", "cpu").preset == "desk"


def changed(name: str, held: Any, kind: Any) -> tuple[str, ...]:
    """What to write after a flag so that its setting changes and stays in range."""
    special = {"friction": "0.4", "dt": "0.0000125", "air_density": "2.5", "settle": "0.5"}
    special |= {"out": "elsewhere", "resolution": "1280x720", "risk": "worst", "start_from": "walker"}
    special |= {"scenarios": "4", "min_wall": "0.001"}
    several = {"sharpen": ("10", "20"), "amplitudes": ("0.5", "1"), "phases": ("0", "0.5"), "duties": ("0.4", "0.5")}
    several |= {"friction_range": ("0.2", "0.8"), "timing": ("phase", "duty"), "slopes": ("0", "0.1")}
    several |= {"chamber_design": ("place", "size"), "chamber_centers": ("0", "0", "0.0175") * 2}
    several |= {"chamber_sizes": ("0.0175", "0.0175", "0.0175") * 2}
    if name in several:
        return several[name]
    if name in special:
        return (special[name],)
    if typing.get_origin(kind) is typing.Literal:
        return (next(choice for choice in typing.get_args(kind) if choice not in (held, "cuda")),)
    if isinstance(held, bool):
        return ()
    if held is None:
        return ("elsewhere",)
    numbers = held if isinstance(held, tuple) else (held,)
    return tuple(str(v + 1 if isinstance(v, int) else 0.5 * v or 0.004) for v in numbers)


def test_every_setting_can_be_overridden():
    hints, paper, written = typing.get_type_hints(Settings), PRESETS["paper"], {}
    for field in dataclasses.fields(Settings):
        # "overwrite" excludes "resume", and "self_contact" the updated formulation.
        if field.name not in ("preset", "overwrite", "self_contact"):
            written[field.name] = changed(field.name, getattr(paper, field.name), hints[field.name])
    flags = [word for name, values in written.items() for word in ("--" + name.replace("_", "-"), *values)]
    chosen = parse("--preset", "paper", *flags)
    assert parse("--overwrite").overwrite and parse("--self-contact").self_contact
    for name, values in written.items():
        seen = getattr(chosen, name)
        assert seen != getattr(paper, name), name
        seen = seen if isinstance(seen, tuple) else (seen,)
        seen = sum(seen, ()) if seen and isinstance(seen[0], tuple) else seen
        assert not values or seen == tuple(type(one)(value) for one, value in zip(seen, values, strict=True)), name


@pytest.mark.parametrize(
    ("arguments", "seen"),
    [
        (("--slop", "0.3"), "--slop"),
        (("--slo", "0.3"), "--slo"),
        (("0.3",), "0.3"),
        (("--slope",), "--slope"),
        (("--slope", "abc"), "abc"),
        (("--iterations", "2.5"), "2.5"),
        (("--particles", "8", "8"), "--particles"),
        (("--preset", "bench"), "bench"),
        (("--device", "tpu"), "tpu"),
        (("--friction", "slick"), "slick"),
    ],
)
def test_what_is_unknown_or_mistyped_ends_with_code_two_and_names_it(arguments, seen, capsys):
    with pytest.raises(SystemExit) as error:
        parse(*arguments)
    assert error.value.code == 2
    assert seen in capsys.readouterr().err


def test_the_help_names_every_setting_with_its_words_and_keeps_commands_on_their_lines(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    with pytest.raises(SystemExit) as error:
        from_command_line(
            PRESETS,
            description="A title.\n\n    python one.py   # first\n    python two.py   # second\n\nThe end\nof it.",
            arguments=["--help"],
        )
    assert not error.value.code
    lines = [line.strip() for line in capsys.readouterr().out.splitlines()]
    assert "$ python one.py   # first" in lines
    assert "$ python two.py   # second" in lines
    assert "The end of it." in lines
    text = "\n".join(lines)
    for field in dataclasses.fields(Settings):
        assert "--" + field.name.replace("_", "-") in text
    assert text.count("(default:") == len(dataclasses.fields(Settings))
    assert "Equilibrium Young's modulus [Pa]. (default: 440000.0)" in text


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *[(name, bad) for name in ("gravity", "slope", "room", "upright") for bad in (-0.1, math.inf, math.nan)],
        *[(name, bad) for name in ("duration", "frequency", "learning_rate", "dt") for bad in (0.0, -1.0, math.nan)],
        *[(name, 0) for name in ("iterations", "window", "gravity_every", "picture_every", "shape_every", "frames")],
        *[(name, -1) for name in ("gravity_steps", "halvings", "patience")],
        *[("resolution", bad) for bad in ("", "960", "961x640", "960x100", "-960x640", "960x99999")],
        *[("fps", bad) for bad in (0, 121)],
        *[("c_max", bad) for bad in (0.0, 0.25, math.nan)],
        ("settle", 0.0100625),  # half a substep too long
        ("duration", 0.0200625),
        ("sample_every", 0.0001),
        ("sample_every", 0.003),  # the end of settling would not be sampled
    ],
)
def test_bad_numbers_are_refused_by_name(name, value):
    with pytest.raises(ValueError, match=rf"(^|, ){name}\b|= {name}\b|settle = .* sample_every") as error:
        dataclasses.replace(TINY, **{name: value})
    assert "wanted" in str(error.value)


def test_cuda_is_refused_where_there_is_none(monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ValueError, match="device = 'cuda'"):
        dataclasses.replace(TINY, device="cuda")


def test_gravity_rises_in_steps():
    assert [TINY.gravity_scale(k) for k in (0, 5)] == [1, 1]
    slow = dataclasses.replace(TINY, gravity_steps=2, gravity_every=3)
    assert [slow.gravity_scale(k) for k in range(8)] == [0, 0, 0, 0.5, 0.5, 0.5, 1, 1]


def test_what_may_change_on_resume_exists():
    assert set(TINY.free) <= {field.name for field in dataclasses.fields(Settings)}


def test_errors_that_a_user_can_act_on_become_one_line(capsys):
    broken = SimulationDiverged(step=3, time=1e-3, particle=5, quantity="NaN", remedy="a smaller step")
    for error, code in ((ValueError("wall = 0"), 2), (broken, 1), (KeyboardInterrupt(), 130)):
        with pytest.raises(SystemExit) as end, plain_errors():
            raise error
        assert end.value.code == code
    assert capsys.readouterr().err == f"error: wall = 0\nerror: {broken}\n"
    with pytest.raises(np.linalg.LinAlgError), plain_errors():
        np.linalg.inv(np.zeros((2, 2)))
    with pytest.raises(TypeError), plain_errors():
        raise TypeError("a bug")


def test_the_projection_sharpens_by_equal_factors_between_two_iterations():
    s = dataclasses.replace(TINY, beta=2.0, final_beta=18.0, sharpen=(10, 30))
    assert [s.sharpness(k) for k in (0, 10, 20, 30, 99)] == pytest.approx([2, 2, 6, 18, 18])
    assert dataclasses.replace(s, sharpen=(0, 0)).sharpness(99) == 2.0
    with pytest.raises(ValueError, match="two increasing iterations"):
        dataclasses.replace(TINY, sharpen=(30, 30))


def test_designs_count_with_full_gravity_and_features_of_whole_thickness():
    assert WALKER["desk"].counts_from == WALKER["paper"].counts_from == 0
    assert CLIMBER["desk"].counts_from == 20 and CLIMBER["paper"].counts_from == 80
    thick = dataclasses.replace(WALKER["desk"], feature=2.5e-3)
    assert thick.sharpened(thick.counts_from - (67 - 25)) == 1.0 > thick.sharpened(thick.counts_from - 1 - (67 - 25))
    assert CLIMBER["desk"].gravity_scale(20) == 1.0 > CLIMBER["desk"].gravity_scale(19)
