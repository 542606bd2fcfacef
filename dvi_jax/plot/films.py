"""Films of orbits: GIF by Pillow, which comes with matplotlib, MP4 by ffmpeg, if it is there."""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.animation import AbstractMovieWriter, FFMpegWriter, writers
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Line3DCollection
from PIL import Image

from .._checks import one_of, positive
from . import series
from .axes import legend
from .orbits import View, label_plane, label_view, phase_portrait, view_of
from .states import Lane, lanes_of, looks_of, one_shape, place_in, troubles
from .style import CROSS, STAR, in_style

_FASTEST_GIF = 50
"""Frames a second: viewers slow down a GIF with shorter delays than 2/100 s."""

_MOST_BYTES = 2**28
"""Largest size of all frames of a GIF, a byte for each pixel, which are in memory together."""

_TAIL = 300
"""Segments of a tail at most."""

_GHOSTS = 12
"""Largest number of tracks that are drawn as a whole, pale, behind the moving parts."""

_DOT: dict[str, Any] = {"marker": "o", "linestyle": "none", "markersize": 6}
_DOT |= {"markeredgecolor": "black", "markeredgewidth": 0.6}


_PLAIN = Image.Dither.NONE


class _Track(NamedTuple):
    """One moving body: its coordinates, of shape (S,) each, its orbit and its colour."""

    lane: int
    coordinates: list[np.ndarray]
    colour: Any
    name: str


@in_style
def animate(
    orbits: Any,
    path: str | Path,
    coordinates: tuple[int, ...] | None = None,
    bodies: Sequence[int] | None = None,
    centre: Any = None,
    beside: str | None = None,
    values: Mapping[str, Any] | None = None,
    change: str = "relative",
    log: bool = False,
    dof: Any = None,
    seconds: float = 8.0,
    fps: float = 25.0,
    tail: float = 0.2,
    names: Sequence[str] | None = None,
    labels: Sequence[str] | None = None,
    units: Mapping[str, str] | None = None,
    title: str = "",
    size: tuple[float, float] | None = None,
    dpi: float = 100.0,
    progress: Callable[[int, int], Any] | None = None,
) -> Path:
    """A film of orbits with a fading tail, evenly in time; of one degree of freedom in (q, p).

    - `orbits`, `coordinates`, `bodies`, `centre`, `names`, `labels`, `units`, `title`: as for
      `orbit`; `units` also of "t", for the time that is shown.
    - `path`: ends in ``.gif``, or in ``.mp4`` if ffmpeg is installed. Its folder must exist.
    - `beside`: "phase_portrait", of `dof`, or "invariants", of `values`, `change` and `log`: a
      second picture, as the functions of these names draw it, in which the moment is marked.
    - `seconds`: how long the film is; `fps`: frames a second, of a GIF at most 50. A run with fewer
      saved states than frames has as many frames as states, which last longer.
    - `tail`: its length, as a share of the run.
    - `size`: inches; `dpi`: pixels an inch. `progress`: called with the numbers of frames done and
      of all, after each.

    A cross stays where an orbit ended too early, and the legend says how many did and why. A file
    of that name is replaced once the film is whole.

    **Returns** the path.

    **Raises** `ValueError` for another suffix, numbers that are no length or rate, a GIF of more
    than 2²⁸ pixels, and as `orbit` does; `RuntimeError` for an MP4 without ffmpeg.
    """
    path = Path(path)
    is_gif = path.suffix.lower() == ".gif"
    _check_film(path, seconds, fps, tail, beside)
    lanes = lanes_of(orbits, labels, momenta=False)
    tracks, view = _tracks(lanes, coordinates, bodies, centre, names)
    times = _moments(lanes, seconds * fps)
    width, height = size or ((9.6, 4.6) if beside else (5.0, 4.8))
    pixels = round(width * dpi) * round(height * dpi)
    if is_gif and pixels * len(times) > _MOST_BYTES:
        raise ValueError(
            f"a GIF of {len(times)} frames of {pixels} pixels is too large to be held, and to be "
            "shown anywhere: take fewer seconds, a lower fps, a smaller size or dpi, or .mp4."
        )
    figure = Figure(figsize=(width, height), dpi=dpi, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    space = view is not None and len(view.coordinates) == 3
    grid = figure.add_gridspec(1, 2 if beside else 1)
    axis = figure.add_subplot(grid[0], projection="3d" if space else None)
    scene = _Scene(axis, tracks, lanes, times, tail)
    scene.prepare(view, units or {}, title)
    if beside == "phase_portrait":
        scene.mark_phase(figure.add_subplot(grid[1]), orbits, dof, units)
    elif beside == "invariants":
        scene.mark_invariants(grid[1], orbits, values, change, log, units)
    scene.show(len(times) - 1)
    canvas.draw()  # the layout of the fullest frame is that of all
    figure.set_layout_engine("none")
    part = path.with_name(f".{path.stem}.part{path.suffix.lower()}")
    rate: Any = len(times) / seconds
    writer = _GifWriter(scene, seconds) if is_gif else FFMpegWriter(rate)
    try:
        write(writer, scene, part, progress)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
    return path


def write(writer: AbstractMovieWriter, scene: "_Scene", path: Path, progress: Any) -> None:
    """Every frame of a scene, in a file."""
    figure, count = scene.axis.figure, len(scene.times)
    with writer.saving(figure, str(path), figure.dpi):
        for frame in range(count):
            scene.show(frame)
            writer.grab_frame()
            if progress is not None:
                progress(frame + 1, count)


def _check_film(path: Path, seconds: float, fps: float, tail: float, beside: Any) -> None:
    suffix = path.suffix.lower()
    if suffix not in (".gif", ".mp4"):
        raise ValueError(f"a film is a .gif or an .mp4, got {path.name!r}.")
    if not path.parent.is_dir():
        raise ValueError(f"the folder of the film is not there: {path.parent}.")
    positive("seconds", seconds)
    positive("fps", fps)
    one_of("beside", beside, (None, "phase_portrait", "invariants"))
    if not 0 <= tail <= 1:
        raise ValueError(f"tail must be a share from 0 to 1, got {tail!r}.")
    if suffix == ".gif" and fps > _FASTEST_GIF:
        raise ValueError(f"a GIF shows at most {_FASTEST_GIF} frames a second, got fps={fps:g}.")
    if suffix == ".mp4" and not writers.is_available("ffmpeg"):
        raise RuntimeError(
            "an .mp4 is written by ffmpeg, which is not found: install it (apt, brew or conda "
            'install ffmpeg), set matplotlib.rcParams["animation.ffmpeg_path"], or write a .gif.'
        )


def _tracks(
    lanes: Sequence[Lane], coordinates: Any, bodies: Any, centre: Any, names: Any
) -> tuple[list[_Track], View | None]:
    if math.prod(one_shape(lanes)) == 1 and coordinates is None and names is None:
        if any(lane.ps is None for lane in lanes):
            raise TypeError("a film of one degree of freedom needs momenta: (ts, qs, ps).")
        place, colours = (0,) * len(lanes[0].shape), looks_of(len(lanes)).colours
        return [
            _Track(i, list(lane.plane(place)), colours[i], lane.label)
            for i, lane in enumerate(lanes)
        ], None
    view = view_of(lanes, coordinates, bodies, centre, names)
    colours = looks_of(len(lanes) if len(lanes) > 1 else len(view.bodies)).colours
    return [
        _Track(i, view.of(lanes[i].qs, k), colours[colour], name)
        for i, k, colour, name in view.lines(lanes)
    ], view


def _moments(lanes: Sequence[Lane], frames: float) -> np.ndarray:
    """Times of the frames, evenly from the first to the last that there is."""
    known = [lane.ts[lane.there] for lane in lanes if lane.there.any()]
    if not known:
        raise ValueError("no orbit has a state that is finite.")
    count = max(2, min(round(frames), max(len(t) for t in known)))
    ends = np.array([[t[0], t[-1]] for t in known])
    times = np.linspace(ends.min(), ends.max(), count)
    return times if (ends[:, 1] >= ends[:, 0]).all() else times[::-1]


class _Scene:
    """The figure of a film, and its moving parts."""

    def __init__(
        self, axis: Any, tracks: list[_Track], lanes: list[Lane], times: np.ndarray, tail: float
    ):
        self.axis, self.tracks, self.lanes, self.times = axis, tracks, lanes, times
        self.length = tail * abs(times[-1] - times[0])
        self.sign = 1.0 if times[-1] >= times[0] else -1.0
        # Each orbit until its last state.
        self.clock = [self.sign * lane.ts[: lane.ended + 1] for lane in lanes]
        self.stride = max(1, math.ceil(tail * max(map(len, self.clock)) / _TAIL))
        self.heads: list[Any] = []
        self.tails: list[Any] = []
        self.crosses: list[Any] = []
        self.moving: list[Callable[[float], None]] = []

    def prepare(self, view: View | None, units: Mapping[str, str], title: str) -> None:
        """Draw what does not move, and one head, tail and cross for each track."""
        axis = self.axis
        pale = {"color": "#cccccc", "linewidth": 0.6, "zorder": 0.8}
        pale["alpha"] = 1.0 if len(self.tracks) <= _GHOSTS else 0.0
        for track in self.tracks:
            axis.plot(*track.coordinates, **pale)
            start = [[float(x[0])] for x in track.coordinates]
            nothing = [np.tile(np.ravel(start), (2, 1))]
            if axis.name == "3d":
                self.tails.append(axis.add_collection3d(Line3DCollection(nothing, linewidths=1.6)))
            else:
                tail = LineCollection(nothing, linewidths=1.6)
                self.tails.append(axis.add_collection(tail, autolim=False))
            look = {"color": track.colour, "label": track.name or None, "zorder": 4}
            self.heads += axis.plot(*start, **_DOT, **look)
            self.crosses += axis.plot(*start, linestyle="none", zorder=5, **CROSS)
        if view is None:
            label_plane(axis, (0,), (1,), units)
        else:
            if view.mark is not None:
                axis.plot(*([x] for x in view.mark), zorder=3, **STAR)
            label_view(axis, view, units)
        legend(axis, True, troubles(self.lanes))
        axis.set_title(title)
        step = abs(self.times[-1] - self.times[0]) / len(self.times)
        digits = int(np.clip(np.ceil(-np.log10(step)), 0, 12)) if step > 0 else 0
        unit = "" if units.get("t") in (None, "", "1") else f" {units['t']}"
        self.clock_text = f"t = {{:.{digits}f}}{unit}"

    def mark_phase(self, axis: Any, orbits: Any, dof: Any, units: Any) -> None:
        """A phase portrait with a dot at the moment."""
        shape = self.lanes[0].shape
        place = (0,) * len(shape) if dof is None else place_in(shape, dof)
        phase_portrait(orbits, dof=place, units=units, ax=axis)
        colours = looks_of(len(self.lanes)).colours
        dots = [axis.plot([], [], color=c, zorder=5, **_DOT)[0] for c in colours]

        def move(t: float) -> None:
            for i, (dot, lane) in enumerate(zip(dots, self.lanes, strict=True)):
                k = self._now(i, t)
                dot.set_data(*([x[k]] if k >= 0 else [] for x in lane.plane(place)))

        self.moving.append(move)

    def mark_invariants(
        self, cell: Any, orbits: Any, values: Any, change: str, log: bool, units: Any
    ) -> None:
        """Quantities along time with a line at the moment."""
        figure = self.axis.figure
        inner = cell.subgridspec(series.panels_of(orbits, values, log), 1)
        axes: list[Any] = []
        for i in range(inner.nrows):
            axes.append(figure.add_subplot(inner[i], sharex=axes[0] if axes else None))
        series.invariants(orbits, values, change=change, log=log, units=units, ax=axes)
        lines = [axis.axvline(self.times[0], color="#000000", linewidth=1) for axis in axes]

        def move(t: float) -> None:
            for line in lines:
                line.set_xdata([t, t])

        self.moving.append(move)

    def _now(self, lane: int, t: float) -> int:
        """Number of the state that an orbit shows at a time, −1 for none."""
        return int(np.searchsorted(self.clock[lane], self.sign * t, side="right")) - 1

    def show(self, frame: int) -> None:
        """Move everything to a frame."""
        t = float(self.times[frame])
        for i, track in enumerate(self.tracks):
            self._show_track(i, track, t)
        for move in self.moving:
            move(t)
        self.axis.set_title(self.clock_text.format(t), loc="right", fontweight="normal")

    def _show_track(self, i: int, track: _Track, t: float) -> None:
        now, clock = self._now(track.lane, t), self.clock[track.lane]
        last = len(clock) - 1
        first = int(np.searchsorted(clock, self.sign * t - self.length)) if len(clock) else 0
        # The same states in every frame, so that a tail of few does not flicker.
        places = np.arange(first, now + 1)
        places = places[(places % self.stride == 0) | (places == now)]
        points = np.stack([x[places] for x in track.coordinates], 1)
        if len(points) < 2:  # matplotlib cannot draw a tail without points
            points = np.full((2, len(track.coordinates)), np.nan)
        segments = np.stack([points[:-1], points[1:]], 1)
        fade = np.linspace(0, 1, len(segments) + 1)[1:]
        colours = np.column_stack([np.tile(to_rgb(track.colour), (len(segments), 1)), fade])
        self.tails[i].set_segments(list(segments))
        self.tails[i].set_color(colours)
        over = bool(self.lanes[track.lane].trouble) and now >= last
        alive = [] if now < 0 or over else [now]
        _put(self.heads[i], [x[alive] for x in track.coordinates])
        _put(self.crosses[i], [x[[last]] if over and last >= 0 else [] for x in track.coordinates])


def _put(line: Any, coordinates: Sequence[Any]) -> None:
    (line.set_data if len(coordinates) == 2 else line.set_data_3d)(*coordinates)


class _GifWriter(AbstractMovieWriter):
    """A GIF with one palette for all frames, in which colours do not flicker.

    Its delays are whole hundredths of a second, and their sum is `seconds`.
    """

    def __init__(self, scene: _Scene, seconds: float):
        super().__init__()
        count = len(scene.times)
        self.delays = 10 * np.diff(np.round(100 * seconds * np.arange(count + 1) / count))
        samples = []  # frames that together have what there is
        for frame in np.unique(np.linspace(0, count - 1, 4).astype(int)):
            scene.show(frame)
            samples.append(np.asarray(_drawn(scene.axis.figure)))
        self.palette = Image.fromarray(np.concatenate(samples)).quantize(256, dither=_PLAIN)
        colours = np.asarray(self.palette.getpalette()).reshape(-1, 3)
        colours[colours.min(1) >= 248] = 255  # paper stays white
        self.palette.putpalette(colours.ravel().tolist())
        self.palette.load()

    def setup(self, fig: Any, outfile: Any, dpi: float | None = None) -> None:
        self.fig, self.outfile, self.dpi = fig, outfile, dpi or fig.dpi
        self.frames: list[Any] = []

    def grab_frame(self, **savefig_kwargs: Any) -> None:
        drawn = _drawn(self.fig)
        self.frames.append(drawn.quantize(palette=self.palette, dither=_PLAIN))

    def finish(self) -> None:
        if not self.frames:  # the first could not be drawn
            return
        first, *others = self.frames
        delays = self.delays.astype(int).tolist()
        look = {"save_all": True, "append_images": others, "duration": delays, "loop": 0}
        first.save(self.outfile, format="GIF", **look)


def _drawn(figure: Any) -> Any:
    figure.canvas.draw()
    return Image.fromarray(np.asarray(figure.canvas.buffer_rgba())[..., :3].copy())
