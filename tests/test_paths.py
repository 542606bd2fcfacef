"""Paths that users give: the home directory, and things that are not files or directories."""

import json
import os
import shutil
import signal
from contextlib import contextmanager
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest
from cli import command, refuses, write

import dvi_jax as dvi
from dvi_jax import plot
from dvi_jax.base.files import publish_npz, read_npz, user_file, user_folder, user_path
from dvi_jax.sweep.store import Store
from dvi_jax.systems import boozer, rings
from lanewise.native import cache

DEEP = "[" * 100_000


@pytest.fixture
def home(tmp_path, monkeypatch):
    """The home directory, which is not the working directory."""
    home, here = tmp_path / "home", tmp_path / "here"
    home.mkdir()
    here.mkdir()
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.chdir(here)
    yield home
    assert not any(path.name.startswith("~") for path in tmp_path.rglob("*"))


@contextmanager
def in_seconds(seconds):
    """What is in here does not block."""

    def stop(*_):
        raise AssertionError(f"not done after {seconds} s")

    signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    path = tmp_path_factory.mktemp("stores") / "s.zarr"
    sweep(path)
    return path


@pytest.fixture
def copy(store, tmp_path):
    return Path(shutil.copytree(store, tmp_path / "copy.zarr"))


def sweep(path):
    system = dvi.System(lambda t0, t1, q0, p1, args: (p1 @ p1 + q0 @ q0) / 2)
    how = {"h": 0.1, "num_steps": 3, "epsilon": dvi.Axis("epsilon", [0.1, 0.2])}
    how["save"] = dvi.Save(final=True)
    return dvi.sweep(system, [1.0], [0.5], store=path, progress=False, **how)


# --- the home directory ---------------------------------------------------------------------------


def test_paths_are_expanded_as_in_a_shell(home, monkeypatch):
    assert user_path("store", "~/x") == home / "x"
    assert user_path("store", Path("~")) == home
    assert user_path("store", "a/~/x") == Path("a/~/x")
    for check in (user_path, user_file, user_folder):
        with pytest.raises(
            ValueError, match=r"store='~nobody\.here/x' .* home directory.*\./~name"
        ):
            check("store", "~nobody.here/x")
        with pytest.raises(ValueError, match="cannot be a path"):
            check("store", "a\0b")
        with pytest.raises(ValueError, match="cannot be a path"):
            check("store", "x" * 300)
        with pytest.raises(TypeError, match=r"store must be a path.*got 3"):
            check("store", 3)


def test_a_store_in_the_home_directory(home):
    assert sweep("~/runs/s.zarr").path == home / "runs/s.zarr"
    assert dvi.open_sweep("~/runs/s.zarr").is_complete
    with pytest.raises(dvi.StoreError, match=r"~nobody\.here"):
        sweep("~nobody.here/s.zarr")


def test_results_in_the_home_directory(home, store):
    dvi.open_sweep(store).to_netcdf("~/sweep.nc")
    field = boozer.from_modes([0], [0], [[1.0]], psi_edge=1.0, iota=0.4, G=1.0, periods=1)
    boozer.save_field(field, "~/field.json")
    assert boozer.load_field("~/field.json").shape == field.shape
    _, axes = plt.subplots()
    plot.save(axes, "~/picture.png")
    publish_npz("~/fit.npz", 1, {"a": 1}, {"x": np.arange(3)})
    header, arrays = read_npz("~/fit.npz", 1, "fit")
    assert (header["a"], [*arrays["x"]]) == (1, [0, 1, 2])
    assert {p.name for p in home.iterdir()} == {"sweep.nc", "field.json", "picture.png", "fit.npz"}


RUN = 'system = "oscillator"\nh = 0.1\nsteps = 3\n[output]\n'


@pytest.mark.slow
def test_paths_of_the_command_line(home):
    write(home, RUN)
    result = command("run", "~/file.toml", "--out=~/out")
    assert result.exit_code == 0, result.output
    assert any((home / "out").iterdir())
    text = RUN.replace("[output]", '[output]\ndir = "~/out"')
    write(home, text)
    refuses(command("run", "~/file.toml"), f"output.dir: {home}/out exists and is not empty")
    assert command("new", "~/project").exit_code == 0
    assert (home / "project/run.toml").is_file()
    refuses(command("run", "~/file.toml", "--out=~nobody.here/x"), "--out: ~nobody.here/x")
    refuses(command("run", "~nobody.here/file.toml"), "CONFIG: ~nobody.here/file.toml")
    refuses(command("new", "~nobody.here/x"), "NAME: ~nobody.here/x")
    refuses(command("sweep", "status", "~nobody.here/x"), "STORE: ~nobody.here/x")
    write(home, text.replace("oscillator", "~/own.py:system"))
    refuses(command("run", "~/file.toml", "--out=x"), "is not in the folder of the TOML file")


# --- neither files nor directories ----------------------------------------------------------------


def test_what_is_no_directory_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    os.mkfifo(tmp_path / "pipe")
    for name, kind in (("file", "file"), ("pipe", "pipe"), ("file/in/it", "file")):
        with pytest.raises(NotADirectoryError, match=f"must be a directory.* is a {kind}:"):
            user_folder("out", tmp_path / name)
        with in_seconds(60), pytest.raises(dvi.StoreError, match=f"is a {kind}"):
            sweep(tmp_path / name)
    with pytest.raises(NotADirectoryError, match="'/dev/null' is a device"):
        user_folder("out", "/dev/null")
    assert user_folder("out", tmp_path / "new/folder") == tmp_path / "new/folder"


def test_pipes_are_not_read(tmp_path, copy):
    os.mkfifo(tmp_path / "pipe.toml")
    pipe = tmp_path / "pipe.toml"
    readers = (boozer.load_field, rings.load, dvi.FitResult.load)
    for read in (*readers, boozer.read_booz_xform, lambda p: dvi.holds_for(None, p)):
        with in_seconds(60), pytest.raises((ValueError, TypeError), match="is a pipe"):
            read(pipe)
    with in_seconds(60):
        refuses(command("run", pipe), "it is a pipe")
    record = Store.open(copy).record_path(0)
    for file in (record, copy / "zarr.json"):
        file.unlink()
        os.mkfifo(file)
    with in_seconds(60), pytest.raises(dvi.StoreError, match="is a pipe"):
        dvi.open_sweep(copy)


def test_a_record_that_is_a_pipe_is_computed_again(copy):
    record = Store.open(copy).record_path(0)
    record.unlink()
    os.mkfifo(record)
    with in_seconds(60):
        assert dvi.open_sweep(copy).tasks_done == 0
        assert sweep(copy).is_complete
    assert record.is_file()


def test_a_cache_that_is_a_pipe_or_has_one(tmp_path, monkeypatch):
    where = tmp_path / "code"
    monkeypatch.setenv(cache.VARIABLE, str(where))
    name = cache.key("a")
    where.mkdir(mode=0o700)
    os.mkfifo(where / name)
    with in_seconds(60):
        assert cache.read(name) is None
        cache.write(name, b"code")
        assert cache.read(name) == b"code"
    for bad in (where / name, where / name / "x", "~nobody.here", "~nobody.here/x", "x" * 300):
        monkeypatch.setenv(cache.VARIABLE, str(bad))
        with pytest.warns(UserWarning, match="DVI_JAX_CACHE=.*not a folder.*not stored"):
            assert cache.folder() is None
        cache.write(name, b"code")  # once is enough
        assert cache.read(name) is None


def test_the_default_cache_ignores_a_relative_folder(home, monkeypatch):
    monkeypatch.delenv(cache.VARIABLE, raising=False)
    for relative in ("~/mine", "mine", ""):
        monkeypatch.setenv("XDG_CACHE_HOME", relative)
        assert cache.folder() == home / ".cache/dvi_jax"


def test_files_of_others_in_the_cache_folder_stay(tmp_path, monkeypatch):
    monkeypatch.setenv(cache.VARIABLE, str(tmp_path))
    tmp_path.chmod(0o700)
    monkeypatch.setattr(cache, "LARGEST", 100)
    (tmp_path / "thesis.txt").write_text("all of it" * 100)
    os.utime(tmp_path / "thesis.txt", (1, 1))
    for part in range(3):
        cache.write(cache.key(part), b"x" * 60)
    assert (tmp_path / "thesis.txt").exists()
    assert len([*tmp_path.iterdir()]) == 2


# --- JSON of a hundred thousand brackets ----------------------------------------------------------


def test_deeply_nested_json_is_a_damaged_file(tmp_path, copy):
    deep = tmp_path / "deep.json"
    for text in (DEEP, DEEP + "]" * len(DEEP), '{"modes": ' + DEEP):
        deep.write_text(text)
        with pytest.raises(ValueError, match="not a field that save_field has written"):
            boozer.load_field(deep)
        with pytest.raises(ValueError, match="is no JSON file"):
            dvi.holds_for(None, deep)
    sound = (copy / "zarr.json").read_text()
    nested = json.loads(sound)
    nested["attributes"]["config"] = DEEP
    units = json.loads(sound)
    units["attributes"]["units"] = DEEP
    for text in (DEEP, json.dumps(nested), json.dumps(units), b"\xff\xfe".decode("latin-1")):
        (copy / "zarr.json").write_bytes(text.encode("latin-1"))
        with pytest.raises(dvi.StoreError, match="does not describe a sweep"):
            dvi.open_sweep(copy)


def test_a_record_of_brackets_is_computed_again(copy):
    from dvi_jax.sweep.store import _crc32

    record = Store.open(copy).record_path(0)
    record.write_bytes(DEEP.encode() + f"\n{_crc32(DEEP.encode())}\n".encode())
    assert dvi.open_sweep(copy).tasks_done == 0
