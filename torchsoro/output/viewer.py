"""A motion in a browser: the design whole or cut, the gait over time, the pressure; served by viser on this machine."""

from __future__ import annotations

import contextlib
import errno
import io
import socket
import threading
import time
import webbrowser
from typing import Any, Literal

import numpy as np
import viser

from torchsoro.output.motion import Motion, Patch
from torchsoro.output.scene import BODY, BODY_SECTION, PRESSURE, WALL, WALL_SECTION
from torchsoro.output.section import Cut, joined, surfaces

_UNIT = 1e2  # units of the scene per m: the browser's shadows and clipping are made for sizes of order one
_RATE = 30.0  # pictures per second while it plays
_COLORS = {"body": BODY, "wall": WALL, "body section": BODY_SECTION, "wall section": WALL_SECTION}
VIEWS = {"oblique": (-62.0, 18.0), "side": (-90.0, 4.0), "front": (0.0, 4.0), "top": (-90.0, 88.0)}
"""Azimuth and elevation of the camera [degrees], as in the movies."""
SPEEDS = {"real time": 1.0, "1/2": 0.5, "1/5": 0.2, "1/10": 0.1, "1/50": 0.02}
AXES = ("none", "x", "y", "z")


def check_address(host: str, port: int) -> None:
    """Refuse an address that cannot be served on.

    Raises:
        ValueError: for a port that is out of range or taken, or a host that is not this machine's.
    """
    if not 1 <= port <= 65535:
        raise ValueError(f"port = {port}: wanted a number from 1 to 65535")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise ValueError(f"port = {port}: another program listens on it, wanted a free port") from None
        if error.errno in (errno.EACCES, errno.EPERM):
            raise ValueError(f"port = {port}: this user may not listen on it, wanted one above 1023") from None
        raise ValueError(f"host = {host!r}: wanted a name or an address of this machine ({error.strerror})") from None


class Viewer:
    """Serves a motion until :meth:`stop`.

    Args:
        motion: What to show.
        host: Name or address to listen on; ``localhost`` is seen from this machine only.
        port: To listen on.

    Attributes:
        address: To open in a browser.

    Raises:
        ValueError: see :func:`check_address`.
    """

    def __init__(self, motion: Motion, *, host: str = "localhost", port: int = 8080) -> None:
        check_address(host, port)
        self.motion = motion
        self._lock = threading.RLock()
        self._origin = np.asarray(motion.domain.origin)
        self._cut: Cut | None = None
        self._meshes: dict[str, Any] = {}
        self._shown = float(motion.time[0])
        with contextlib.redirect_stdout(io.StringIO()):  # viser's own banner, which names two addresses
            self.server = viser.ViserServer(host=host, port=port, label=motion.name, verbose=False)
        self.address = f"http://{'localhost' if host == '0.0.0.0' else host}:{port}"
        self.server.gui.configure_theme(show_logo=False, show_share_button=False, brand_color=(58, 110, 165))
        self.world = self.server.scene.add_frame("/world", show_axes=False)
        for number, patch in enumerate(motion.stage):
            self._add_plane(f"/world/plane {number}", patch, ticks=number == 0)
        azimuth, elevation = VIEWS["oblique"]
        self.server.initial_camera.position = self._eye(azimuth, elevation)
        self.server.initial_camera.look_at = np.zeros(3)
        self.server.initial_camera.fov = np.radians(32.0)
        self._add_controls()
        self._rebuild()

    # ------------------------------------------------------------------------------------------------------- playing
    def run(self, *, open_browser: bool = True) -> None:
        """Play until the process is interrupted."""
        if open_browser:
            webbrowser.open(self.address)
        before = time.monotonic()
        while True:
            time.sleep(1 / _RATE)
            now = time.monotonic()
            self.advance(now - before)
            before = now

    def advance(self, seconds: float) -> None:
        """Let so many seconds of the clock on the wall pass; nothing happens while the motion is stopped."""
        if not self.playing.value:
            return
        start, end = self.motion.time[[0, -1]]
        self.show(start + (self._shown - start + seconds * SPEEDS[self.speed.value]) % max(end - start, 1e-9))

    def show(self, at: float) -> None:
        """Show the motion at a time [s]."""
        with self._lock, self.server.atomic():
            self._shown = float(np.clip(at, *self.motion.time[[0, -1]]))
            shift, amplitude, pressure = self.motion.at(self._shown)
            for handle, rest, modes in self._meshes.values():
                handle.vertices = (_UNIT * (rest + shift + np.tensordot(amplitude, modes, axes=1))).astype(np.float32)
            if "cavity" in self._meshes:
                share = np.clip(pressure / max(float(self.motion.pressure.max()), 1e-9), 0, 1)
                self._meshes["cavity"][0].color = _rgb(PRESSURE(float(share))[:3])
            middle = self.motion.camera.mean(axis=0)
            center = [np.interp(self._shown, self.motion.time, c) for c in self.motion.camera.T]
            self.world.position = -_UNIT * ((np.array(center) if self.follow.value else middle) - self._origin)
            travel = float(np.interp(self._shown, self.motion.time, self.motion.travel))
            milliseconds = 1e3 * (self._shown - self.motion.time[0])
            self.time.value = milliseconds
            self.state.content = f"travel **{1e3 * travel:.2f} mm** &nbsp; pressure **{1e-3 * pressure:.1f} kPa**"
            self._plot(milliseconds)

    def cut(self, axis: str, position: float, *, other_side: bool = False) -> None:
        """Cut the design by a plane of the undeformed body; set the controls, as a user would.

        Args:
            axis: "x", "y", "z", or "none".
            position: On the axis from the lower corner of the body [mm].
            other_side: Keep the part that would be taken away.
        """
        with self._lock:
            self.axis.value, self.flip.value = axis, other_side  # pyright: ignore[reportAttributeAccessIssue]
            self.position.value = position
            self._recut()

    def stop(self) -> None:
        """Stop serving."""
        with contextlib.redirect_stdout(io.StringIO()):
            self.server.stop()

    # --------------------------------------------------------------------------------------------------------- scene
    def _rebuild(self) -> None:
        """Make the meshes for the present cut."""
        motion = self.motion
        meshes = surfaces(motion.domain, motion.gamma, cut=self._cut)
        vertices, places = joined(meshes)
        modes = motion.carry(vertices)
        rest = vertices - self._origin
        with self._lock, self.server.atomic():
            for name in self._meshes.keys() - meshes.keys():
                self._meshes.pop(name)[0].remove()
            for name, (_, faces) in meshes.items():
                place = places[name]
                handle = self.server.scene.add_mesh_simple(
                    f"/world/robot/{name}",
                    _UNIT * rest[place],
                    faces,
                    color=_rgb(_COLORS.get(name, BODY)),
                    side="double",
                )
                self._meshes[name] = handle, rest[place], modes[:, place]
            self._look_through()
            self.show(self._shown)

    def _recut(self) -> None:
        axis, size = AXES.index(self.axis.value) - 1, np.asarray(self.motion.domain.size)
        if axis < 0:
            self._cut = None
        else:
            # A plane on the very face of the body, or on a lattice plane, has nothing definite on it.
            position = float(np.clip(1e-3 * self.position.value, 1e-5, size[axis] - 1e-5)) + 1e-7
            # What hides the plane from the first view is taken away.
            side = (-1 if axis == 1 else 1) * (-1 if self.flip.value else 1)
            self._cut = Cut(axis, float(self._origin[axis]) + position, side)
        self._rebuild()

    def _look_through(self) -> None:
        for name in ("body", "wall"):
            if name in self._meshes:
                value = self.opacity.value
                self._meshes[name][0].opacity = None if value >= 1 else value

    def _add_plane(self, name: str, patch: Patch, *, ticks: bool) -> None:
        corners = patch.corners * 1e-3 * _UNIT
        first, second = (axis for axis in range(3) if axis != patch.axis)
        low, high = corners[0], corners[3]
        planes: dict[int, Literal["yz", "xz", "xy"]] = {0: "yz", 1: "xz", 2: "xy"}
        self.server.scene.add_grid(
            name,
            width=float(high[first] - low[first]),
            height=float(high[second] - low[second]),
            plane=planes[patch.axis],
            cell_size=5e-3 * _UNIT,
            section_size=10e-3 * _UNIT,
            cell_color=(214, 220, 227),
            section_color=(176, 186, 197),
            plane_color=(238, 241, 244) if patch.axis == 2 else (200, 214, 228),
            plane_opacity=1.0 if patch.axis == 2 else 0.25,
            shadow_opacity=0.25,
            position=0.5 * (low + high),
        )
        for at, distance in zip(patch.ticks * 1e-3 * _UNIT, patch.distances, strict=True) if ticks else ():
            text = f"{distance:.0f} mm" if distance == 0 else f"{distance:.0f}"
            self.server.scene.add_label(f"{name}/{text}", text, position=at - 0.5 * (low + high), anchor="top-center")

    def _eye(self, azimuth: float, elevation: float) -> np.ndarray:
        a, e = np.radians([azimuth, elevation])
        distance = 3.0 * _UNIT * float(np.linalg.norm(self.motion.domain.size))
        return distance * np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])

    # ------------------------------------------------------------------------------------------------------ controls
    def _add_controls(self) -> None:
        gui, motion = self.server.gui, self.motion
        length = 1e3 * float(motion.time[-1] - motion.time[0])
        with gui.add_folder("Motion"):
            self.state = gui.add_markdown("")
            self.playing = gui.add_checkbox("play", True)
            self.time = gui.add_slider("time [ms]", 0.0, max(length, 1e-3), 0.1, 0.0)
            self.speed = gui.add_dropdown("speed", tuple(SPEEDS), initial_value="1/10")
            self.follow = gui.add_checkbox("follow the robot", True)
        with gui.add_folder("Pressure [kPa] over time [ms]"):
            self._trace = self._series(0.0)
            self.plot = gui.add_uplot(
                self._trace,
                series=(
                    {"label": "time [ms]"},
                    {"label": "pressure", "stroke": "#b9a6bd", "width": 1.5},
                    {"label": "so far", "stroke": "#d1344b", "width": 3},
                ),
                scales={"x": {"time": False}},
                legend={"show": False},
                height=150,
            )
        with gui.add_folder("Cut through walls and chamber"):
            self.axis = gui.add_dropdown("normal to", AXES, initial_value="none")
            largest = 1e3 * max(motion.domain.size)
            self.position = gui.add_slider("at [mm]", 0.0, largest, 0.1, 0.5 * 1e3 * motion.domain.size[1])
            self.flip = gui.add_checkbox("other side", False)
            self.opacity = gui.add_slider("opacity", 0.1, 1.0, 0.05, 1.0)
        with gui.add_folder("Camera"):
            self.views = gui.add_button_group("view", tuple(VIEWS))

        @self.time.on_update
        def _(event: viser.GuiEvent) -> None:
            if event.client is not None:  # a user's hand, and not the motion's own progress
                self.playing.value = False
                self.show(float(motion.time[0]) + 1e-3 * self.time.value)

        @self.follow.on_update
        def _(_: viser.GuiEvent) -> None:
            self.show(self._shown)

        @self.opacity.on_update
        def _(_: viser.GuiEvent) -> None:
            self._look_through()

        for control in (self.axis, self.position, self.flip):

            @control.on_update
            def _(event: viser.GuiEvent) -> None:
                if event.client is not None:
                    self._recut()

        @self.views.on_click
        def _(event: viser.GuiEvent) -> None:
            if event.client is not None:
                event.client.camera.up_direction = (0.0, 0.0, 1.0)
                event.client.camera.position = self._eye(*VIEWS[self.views.value])
                event.client.camera.look_at = np.zeros(3)

    def _series(self, milliseconds: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        time, pressure = 1e3 * (self.motion.time - self.motion.time[0]), 1e-3 * self.motion.pressure
        return time, pressure, np.where(time <= milliseconds, pressure, np.nan)

    def _plot(self, milliseconds: float) -> None:
        series = self._series(milliseconds)
        if not np.array_equal(series[2], self._trace[2], equal_nan=True):
            self._trace = self.plot.data = series


def _rgb(color: Any) -> tuple[int, int, int]:
    red, green, blue = (round(255 * float(part)) for part in color)
    return red, green, blue
