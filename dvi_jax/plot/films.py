"""Films of orbits: GIF by Pillow, a dependency of matplotlib, MP4 by ffmpeg, if it is installed."""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.animation import FFMpegWriter, writers
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3DCollection
from PIL import Image

from ..base.checks import one_of, positive
from ..base.files import writable_path
from . import series
from .axes import at_most, check_not_empty, legend
from .orbits import Plane, phase_portrait, view_of
from .states import Lane, lanes_of, looks_of, one_shape, place_in, troubles
from .style import CROSS, STAR, in_style, look_of

_FASTEST_GIF = 50
"""Frames a second: viewers slow down a GIF with shorter delays than 2/100 s."""

_MOST_BYTES = 2**28
"""Largest size of all frames of a GIF, a byte for each pixel, which are in memory together."""

_TAIL, _GHOSTS = 300, 12
"""Largest numbers of segments of a tail, and of orbits that are also drawn as a whole, pale."""

_DOT: dict[str, Any] = {"marker": "o", "ls": "none", "ms": 6}
_DOT |= {"mec": "black", "mew": 0.6}

_VIEW, _CANVAS = ("coordinates", "bodies", "centre", "names"), ("size", "dpi")
_SECOND = {None: (), "phase_portrait": ("dof",), "invariants": ("values", "change", "log")}
"""Keywords of `orbit`, of the figure, and of the second picture."""


@in_style
def animate(
    orbits: Any,
    path: str | Path,
    beside: str | None = None,
    seconds: float = 8.0,
    fps: float = 25.0,
    tail: float = 0.2,
    progress: Callable[[int, int], Any] | None = None,
    **options: Any,
) -> Path:
    """An animation of orbits whose tails fade; the frames are equally spaced in time.

    Orbits of one degree of freedom are drawn in the plane (q, p).

    - `orbits`, and of the keywords `coordinates`, `bodies`, `centre`, `names`, `labels`, `units`,
      `title`: as for `orbit`; `units` also of "t", for the time that is shown.
    - `path`: ends in ``.gif``, or in ``.mp4`` if ffmpeg is installed. Its folder must exist.
    - `beside`: "phase_portrait", with the keyword `dof`, or "invariants", with `values`, `change`
      and `log`: a second picture, as these functions draw it, in which the current time is marked.
    - `seconds`: how long the film is; `fps`: frames a second, of a GIF at most 50. A run with fewer
      saved states than frames has as many frames as states, which last longer.
    - `tail`: its length, as a fraction of the run. `size`: inches; `dpi`: pixels an inch, by
      default 100.
    - `progress`: called with the numbers of frames done and of all, after each.

    A cross stays where an orbit ended too early, and the legend says how many did and why. An
    existing file is replaced when the film is complete.

    **Returns** the path. **Raises** `ValueError` for another suffix, an invalid length or rate, a
    GIF of more than 2²⁸ pixels, and as `orbit` does; `TypeError` for unknown keywords;
    `RuntimeError` for an MP4 without ffmpeg.
    """
    path = writable_path(path)
    suffix = path.suffix.lower()
    _check_film(path, suffix, seconds, fps, tail, beside)
    extra_names = {name for names in (_VIEW, _CANVAS, *_SECOND.values()) for name in names}
    extra = {name: options.pop(name) for name in extra_names & options.keys()}
    look = look_of(options, "colour", "colour_label", "ax")
    lanes = lanes_of(orbits, look.labels, momenta=False)
    view_options = {name: extra[name] for name in _VIEW if name in extra}
    shape = one_shape(lanes)
    is_default = view_options.get("coordinates") is view_options.get("names") is None
    if math.prod(shape) == 1 and is_default:
        view: Any = Plane((0,) * len(shape), (1,))
    else:
        view = view_of(lanes, **view_options)
    times = _moments(lanes, seconds * fps)
    width, height = extra.get("size") or ((9.6, 4.6) if beside else (5.0, 4.8))
    dpi = extra.get("dpi", 100.0)
    pixels = round(width * dpi) * round(height * dpi)
    if suffix == ".gif":
        remedy = "by less seconds, fps, size or dpi, or write an .mp4"
        at_most(_MOST_BYTES, pixels * len(times), "pixels of all frames of a GIF", remedy)
    figure = Figure(figsize=(width, height), dpi=dpi, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    grid = figure.add_gridspec(1, 2 if beside else 1)
    axis = figure.add_subplot(grid[0], projection="3d" if len(view.coordinates) == 3 else None)
    scene = _Scene(axis, lanes, times, look.units.get("t"))
    scene.draw_orbits(view, tail)
    if view.mark is not None:
        axis.plot(*([x] for x in view.mark), zorder=3, **STAR)
    view.name_axes(axis, look.units)
    legend(axis, True, troubles(lanes))
    axis.set_title(look.title)
    second = {name: extra[name] for name in _SECOND[beside] if name in extra}
    if beside == "phase_portrait":
        scene.mark_phase(figure.add_subplot(grid[1]), orbits, second.get("dof"), look.units)
    elif beside == "invariants":
        scene.mark_invariants(grid[1], orbits, second, look.units)
    scene.show(len(times) - 1)
    canvas.draw()  # the layout of the fullest frame is that of all
    figure.set_layout_engine("none")
    part = path.with_name(f".{path.stem}.part{suffix}")
    try:
        (write_gif if suffix == ".gif" else write_mp4)(scene, part, seconds, progress)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    return path


def _check_film(path: Path, suffix: str, seconds: Any, fps: Any, tail: Any, second: Any) -> None:
    one_of("the suffix of path", suffix, (".gif", ".mp4"))
    if not path.parent.is_dir():
        raise ValueError(f"path must lie in an existing folder, got {str(path)!r}.")
    positive("seconds", seconds)
    positive("fps", fps)
    one_of("beside", second, _SECOND)
    if not 0 <= tail <= 1:
        raise ValueError(f"tail must be a fraction from 0 to 1, got {tail!r}.")
    if suffix == ".gif":
        at_most(_FASTEST_GIF, fps, "fps of a GIF", "fps=25, or write an .mp4")
    if suffix == ".mp4" and not writers.is_available("ffmpeg"):
        raise RuntimeError(
            f"path {path.name!r} requires the program ffmpeg, which was not found: install it, set "
            'matplotlib.rcParams["animation.ffmpeg_path"], or write a .gif.'
        )


def _moments(lanes: Sequence[Lane], frames: float) -> np.ndarray:
    """Times of the frames, evenly from the first to the last finite state."""
    finite = [lane.ts[lane.finite] for lane in lanes if lane.finite.any()]
    check_not_empty("the list of finite states in orbits", finite, "see the status of the Solution")
    count = max(2, min(round(frames), max(len(t) for t in finite)))
    ends = np.array([[t[0], t[-1]] for t in finite])
    times = np.linspace(ends.min(), ends.max(), count)
    return times if (ends[:, 1] >= ends[:, 0]).all() else times[::-1]


class _Scene:
    """The figure of a film; `moving` are the functions of time that move its parts."""

    def __init__(self, axis: Any, lanes: list[Lane], times: np.ndarray, unit: str | None):
        self.axis, self.lanes, self.times = axis, lanes, times
        self.sign = 1.0 if times[-1] >= times[0] else -1.0
        self.moving: list[Callable[[float], None]] = []
        # The times of each orbit up to its last finite state.
        counts = [np.max(np.flatnonzero(lane.finite) + 1, initial=0) for lane in lanes]
        self.clocks = [self.sign * x.ts[:n] for x, n in zip(lanes, counts, strict=True)]
        step = abs(times[-1] - times[0]) / len(times)
        digits = int(np.clip(np.ceil(-np.log10(step)), 0, 12)) if step > 0 else 0
        self.text = f"t = {{:.{digits}f}}" + ("" if unit in (None, "", "1") else f" {unit}")

    def show(self, frame: int) -> None:
        """Move everything to a frame."""
        t = float(self.times[frame])
        for move in self.moving:
            move(t)
        self.axis.set_title(self.text.format(t), loc="right", fontweight="normal")

    def place_of(self, lane: int, t: float) -> int:
        """Number of the state that an orbit shows at a time, −1 before the first."""
        return int(np.searchsorted(self.clocks[lane], self.sign * t, side="right")) - 1

    def draw_orbits(self, view: Any, tail: float) -> None:
        """Draw the orbits, pale, and a head, a tail and a cross for each body."""
        stride = max(1, math.ceil(tail * max(map(len, self.clocks)) / _TAIL))
        length = tail * abs(self.times[-1] - self.times[0])
        lines = list(view.lines(self.lanes))
        colours = looks_of(max(number for _, _, number, _ in lines) + 1).colours
        pale = {"color": "#cccccc", "lw": 0.6, "zorder": 0.8}
        pale["alpha"] = 1.0 if len(lines) <= _GHOSTS else 0.0
        for i, k, number, name in lines:
            xs = view.coordinates_of(self.lanes[i], k)
            self.axis.plot(*xs, **pale)
            look = {"color": colours[number], "label": name or None, "zorder": 4}
            self.moving.append(self._moving_body(i, xs, look, length, stride))

    def _moving_body(self, lane: int, xs: Any, look: Any, length: float, stride: int) -> Any:
        axis, clock = self.axis, self.clocks[lane]
        start = [[float(x[0])] for x in xs]
        start_segment = [np.tile(np.ravel(start), (2, 1))]
        if axis.name == "3d":
            tail: Any = axis.add_collection3d(Line3DCollection(start_segment, linewidths=1.6))
        else:
            tail = axis.add_collection(LineCollection(start_segment, linewidths=1.6), autolim=False)
        (head,) = axis.plot(*start, **_DOT, **look)
        (cross,) = axis.plot(*start, ls="none", zorder=5, **CROSS)
        last, ends_early = len(clock) - 1, bool(self.lanes[lane].trouble)

        def move(t: float) -> None:
            place = self.place_of(lane, t)
            first = int(np.searchsorted(clock, self.sign * t - length)) if len(clock) else 0
            # The same states in every frame, so that a tail of few does not flicker.
            places = np.arange(first, place + 1)
            places = places[(places % stride == 0) | (places == place)]
            points = np.stack([x[places] for x in xs], 1)
            if len(points) < 2:  # matplotlib cannot draw a tail without points
                points = np.full((2, len(xs)), np.nan)
            segments = np.stack([points[:-1], points[1:]], 1)
            fade = np.linspace(0, 1, len(segments) + 1)[1:]
            tail.set_segments(list(segments))
            tail.set_color(np.c_[np.tile(to_rgb(look["color"]), (len(segments), 1)), fade])
            has_ended = ends_early and place >= last
            _put(head, xs, [] if place < 0 or has_ended else [place])
            _put(cross, xs, [last] if has_ended and last >= 0 else [])

        return move

    def mark_phase(self, axis: Any, orbits: Any, dof: Any, units: Any) -> None:
        """A phase portrait with a dot at the current time."""
        shape = one_shape(self.lanes)
        plane = Plane((0,) * len(shape) if dof is None else place_in("dof", shape, dof), shape)
        phase_portrait(orbits, dof=plane.place, units=units, ax=axis)
        for i, colour in enumerate(looks_of(len(self.lanes)).colours):
            (dot,) = axis.plot([], [], color=colour, zorder=5, **_DOT)

            def move(t: float, i: int = i, dot: Any = dot) -> None:
                place = self.place_of(i, t)
                _put(dot, plane.coordinates_of(self.lanes[i]), [place] if place >= 0 else [])

            self.moving.append(move)

    def mark_invariants(self, cell: Any, orbits: Any, options: Any, units: Any) -> None:
        """Quantities along time with a line at the current time."""
        count = series.panels_of(orbits, options.get("values"), options.get("log", False))
        inner, axes = cell.subgridspec(count, 1), []
        for i in range(count):
            first = axes[0] if axes else None
            axes.append(self.axis.figure.add_subplot(inner[i], sharex=first))
        series.invariants(orbits, units=units, ax=axes, **options)
        for axis in axes:
            line = axis.axvline(self.times[0], color="#000000", lw=1)
            self.moving.append(lambda t, line=line: line.set_xdata([t, t]))


def _put(line: Any, xs: Sequence[np.ndarray], places: list[int]) -> None:
    (line.set_data if len(xs) == 2 else line.set_data_3d)(*(x[places] for x in xs))


def write_mp4(scene: _Scene, path: Path, seconds: float, progress: Any) -> None:
    """Write every frame of a scene as a film of this length."""
    figure, count = scene.axis.figure, len(scene.times)
    rate: Any = count / seconds
    writer = FFMpegWriter(rate)
    with writer.saving(figure, str(path), figure.dpi):
        for frame in range(count):
            scene.show(frame)
            writer.grab_frame()
            if progress is not None:
                progress(frame + 1, count)


def write_gif(scene: _Scene, path: Path, seconds: float, progress: Any) -> None:
    """The same as a GIF with one palette for all frames, so that colours do not flicker.

    Its delays are whole hundredths of a second, and their sum is `seconds`.
    """
    count, plain, canvas = len(scene.times), Image.Dither.NONE, scene.axis.figure.canvas

    def image_of(frame: int) -> Any:
        scene.show(frame)
        canvas.draw()
        return Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3].copy())

    # The palette is that of four frames, which together have all colours.
    samples = [np.asarray(image_of(k)) for k in np.unique(np.linspace(0, count - 1, 4).astype(int))]
    palette = Image.fromarray(np.concatenate(samples)).quantize(256, dither=plain)
    colours = np.asarray(palette.getpalette()).reshape(-1, 3)
    colours[colours.min(1) >= 248] = 255  # paper stays white
    palette.putpalette(colours.ravel().tolist())
    palette.load()
    frames = []
    for frame in range(count):
        frames.append(image_of(frame).quantize(palette=palette, dither=plain))
        if progress is not None:
            progress(frame + 1, count)
    delays = 10 * np.diff(np.round(100 * seconds * np.arange(count + 1) / count))
    look: Any = {"save_all": True, "duration": delays.astype(int).tolist(), "loop": 0}
    frames[0].save(path, format="GIF", append_images=frames[1:], **look)
