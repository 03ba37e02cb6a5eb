"""What every command line shares: options that are checked when they are made, and errors told in a line."""

from __future__ import annotations

import contextlib
import functools
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from typing import Annotated, Any, Protocol, TypeVar, dataclass_transform

import numpy as np
import pydantic
from pydantic import Field
from pydantic.dataclasses import dataclass
from tqdm import tqdm

from torchsoro.errors import SimulationDiverged

# Numbers of options. Strict: neither text nor a truth value counts as a number.
Positive = Annotated[float, Field(strict=True, gt=0, allow_inf_nan=False)]
AtLeastZero = Annotated[float, Field(strict=True, ge=0, allow_inf_nan=False)]
Share = Annotated[float, Field(strict=True, gt=0, lt=1)]
Count = Annotated[int, Field(strict=True, ge=1, le=10**6)]
CountOrZero = Annotated[int, Field(strict=True, ge=0, le=10**6)]

Options = TypeVar("Options", bound=type)


@dataclass_transform(frozen_default=True, kw_only_default=True, field_specifiers=(Field,))
def options(plain: Options) -> Options:
    """Make a class a frozen dataclass whose values pydantic checks against their annotations.

    Text below a field becomes its description. The class may check in ``__post_init__`` what concerns several fields.

    Args:
        plain: Class of annotated fields with defaults.

    Returns:
        The dataclass; making one with a value out of its range raises a ``ValueError`` that names field, value and
        what is wanted.
    """
    config = pydantic.ConfigDict(extra="forbid", use_attribute_docstrings=True)
    made: Any = dataclass(frozen=True, kw_only=True, config=config)(plain)
    unexplained = made.__init__

    @functools.wraps(unexplained)
    def __init__(self: Any, **values: Any) -> None:
        try:
            unexplained(self, **values)
        except pydantic.ValidationError as error:
            raise ValueError(complaint(error)) from None

    made.__init__ = __init__
    return made


def complaint(error: pydantic.ValidationError) -> str:
    """What pydantic found, as ``name = value: wanted ...``; several faults are joined by semicolons."""
    faults: dict[str, tuple[Any, list[str]]] = {}
    own: list[str] = []
    for one in error.errors(include_url=False):
        # The place is a name and indices; branches of a union, which pydantic adds, are left out.
        name, *inner = one["loc"] or ("",)
        if one["type"] == "value_error" and not name:
            own.append(str(one.get("ctx", {})["error"]))
            continue
        place = f"{name}{''.join(f'[{i}]' for i in inner if isinstance(i, int))}"
        wanted = faults.setdefault(place, (one["input"], []))[1]
        if (phrase := _wanted(one["type"], one["msg"], one.get("ctx", {}))) not in wanted:
            wanted.append(phrase)
    return "; ".join(
        [*own, *(f"{name} = {value!r}: wanted {' or '.join(wanted)}" for name, (value, wanted) in faults.items())]
    )


def _wanted(kind: str, message: str, numbers: dict[str, Any]) -> str:
    """What a field wants, in words."""
    limits = {"greater_than": "gt", "greater_than_equal": "ge", "less_than": "lt", "less_than_equal": "le"}
    words = {"gt": "more than", "ge": "at least", "lt": "less than", "le": "at most"}
    if kind in limits:
        key = limits[kind]
        return "finite and positive" if (key, numbers[key]) == ("gt", 0) else f"{words[key]} {numbers[key]}"
    others = {
        "finite_number": "a finite number",
        "float_type": "a number",
        "int_type": "a whole number",
        "unexpected_keyword_argument": "no such name",
        "bool_type": "true or false",
        "tuple_type": "a list",
        "too_long": f"{numbers.get('max_length')} values",
        "missing": "one more value",
    }
    if kind == "literal_error":
        return str(numbers["expected"])
    return others.get(kind) or message[:1].lower() + message[1:]


@contextlib.contextmanager
def progress_bar(stage: str) -> Iterator[Callable[[int, int], None]]:
    """Show stage, percent and time left on the error stream.

    Yields:
        A function to call with what is done and what there is to do in all; less done than before begins again.
    """
    interval = 0.1 if sys.stderr.isatty() else 10.0  # s; in a log file every refresh is a line
    form = "{desc}: {percentage:3.0f} % |{bar:30}| {elapsed} so far, {remaining} left"
    with tqdm(desc=stage, total=1, mininterval=interval, bar_format=form) as bar:

        def show(done: int, total: int) -> None:
            if done < bar.n:
                bar.reset()
            bar.total = total
            bar.update(done - bar.n)

        yield show


class CommandLine(Protocol):
    """What runs a recipe with the arguments of a command line, the process's own if None."""

    def __call__(self, arguments: Sequence[str] | None = None) -> None:
        """Read the arguments and run."""


def program(main: Callable[[Any], object], options: type, description: str | None) -> CommandLine:
    """The command line of a recipe: options are read and checked, and errors are told in a line.

    Args:
        main: What the recipe does with its options.
        options: Class of the options.
        description: Text on top of ``--help``.

    Returns:
        A function of the arguments, which are the process's own if None. It raises ``SystemExit`` as
        :func:`plain_errors` does, after ``--help``, and for an unknown flag.
    """

    def cli(arguments: Sequence[str] | None = None) -> None:
        import tyro  # takes a while to import

        with plain_errors():
            main(tyro.cli(options, description=as_called(description), args=arguments))

    return cli


def as_called(description: str | None) -> str:
    """The description of a recipe, whose examples are those of the console script where that is what runs."""
    text = description or ""
    script = sys.argv[0].startswith("torchsoro ")
    return re.sub(r"python recipes/(\w+)\.py", r"torchsoro \1", text) if script else text


@contextlib.contextmanager
def plain_errors() -> Iterator[None]:
    """End the process with a line instead of a traceback.

    Exit code 2 for bad input; 1 for a simulation that diverged, a file that cannot be read or written, and too little
    memory; 130 for Ctrl-C. A matrix that is no numbers is a defect and no bad input, though a ``ValueError``: it keeps
    its traceback.
    """
    try:
        yield
    except BrokenPipeError:  # whoever read the output, such as head, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # so that nothing fails when it is flushed
        raise SystemExit(0) from None
    except np.linalg.LinAlgError:
        raise
    except (ValueError, SimulationDiverged, OSError, MemoryError) as error:
        print(f"error: {error or 'not enough memory'}", file=sys.stderr)
        raise SystemExit(2 if isinstance(error, ValueError) else 1) from error
    except KeyboardInterrupt:
        raise SystemExit(130) from None


def parse_resolution(text: str) -> tuple[int, int]:
    """Width and height in pixels from a text such as ``1280x720``.

    Raises:
        ValueError: for another text.
    """
    width, by, height = text.partition("x")
    sizes = [int(size) if size.isdecimal() and len(size) < 5 else 0 for size in (width, height)]
    if not by or any(size < 160 or size > 7680 or size % 2 for size in sizes):
        raise ValueError(
            f"resolution = {text!r}: wanted width x height in pixels, even numbers from 160 to 7680, such as 1280x720"
        )
    return sizes[0], sizes[1]
