"""The store of sweeps: resuming, ends of a process at any moment, damage of every kind."""

import itertools
import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
import warnings
import zlib
from collections import Counter
from pathlib import Path

import faults
import numpy as np
import pytest
import sweep_child
import xarray as xr
from sweep_child import sweep

import dvi_jax as dvi
from dvi_jax.sweep import claims, store as stores
from dvi_jax.sweep.identity import digest
from dvi_jax.sweep.store import Store

VARIABLES = ("drift", "end", "t", "q", "p", "status", "failed_step", "residual")
HERE = Path(__file__).parent


@pytest.fixture(scope="module")
def expected():
    return sweep(None)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    path = tmp_path_factory.mktemp("sweeps") / "whole.zarr"
    sweep(path)
    return path


@pytest.fixture
def copy(finished, tmp_path):
    return Path(shutil.copytree(finished, tmp_path / "copy.zarr"))


def same(a, b):
    for name in VARIABLES:
        np.testing.assert_array_equal(a[name], b[name])


def shard(path, name="drift", task=3):
    return Store.open(path).shard_path(name, task)


def record(path, task=3):
    return Store.open(path).record_path(task)


def flip(path: Path, where: int):
    content = bytearray(path.read_bytes())
    content[where] ^= 1
    path.write_bytes(content)


@pytest.mark.slow
def test_a_store_has_the_bits_of_memory_and_other_programs_read_it(expected, finished):
    found = dvi.open_sweep(finished)
    assert found.is_complete
    same(found, expected)
    assert found.status_counts() == expected.status_counts()
    assert found.status_counts() == {"successful": 1175, "not_finite": 25}
    a, b = found.to_xarray(), expected.to_xarray()
    xr.testing.assert_identical(a.drop_attrs(), b.drop_attrs())
    for key in ("host", "jax", "created", "git_revision", "config"):
        assert isinstance(a.attrs[key], str)
    with xr.open_zarr(finished, chunks=None) as ds:
        assert ds.drift.dims == ("epsilon", "start")
        assert ds.sel(start=3).status.attrs["flag_meanings"].startswith("not_computed successful")
        np.testing.assert_array_equal(ds.drift, expected["drift"])
        assert "q0" in ds.coords


def test_the_format_on_disk(finished):
    """Other versions read it: these names and entries may only be changed with the format."""
    about = json.loads((finished / "zarr.json").read_text())["attributes"]
    assert about["dvi_jax_sweep"] == 1
    assert {"dims", "chunk", "variables", "args", "program"} < json.loads(about["config"]).keys()
    body, checksum = (finished / ".tasks/000000/000000003.json").read_bytes().splitlines()
    assert checksum == f"{zlib.crc32(body):08x}".encode()
    entries = json.loads(body)
    assert (entries["task"], entries["start"], entries["size"]) == (3, [12, 0], [4, 25])
    assert (entries["statuses"], entries["config_sha256"]) == ({"successful": 100}, digest(
        json.loads(about["config"])))  # fmt: skip
    content = (finished / "drift/c/3/0").read_bytes()
    crc32 = f"{zlib.crc32(content):08x}"
    assert entries["shards"]["drift"] == {"bytes": len(content), "crc32": crc32}


@pytest.mark.slow
def test_only_the_necessary_parts_are_read(finished, expected, monkeypatch):
    lazy, whole, read = dvi.open_sweep(finished).to_xarray(), expected["drift"], []
    record = Store.record
    monkeypatch.setattr(Store, "record", lambda self, n: read.append(n) or record(self, n))
    np.testing.assert_array_equal(lazy.drift[4:8, 3], whole[4:8, 3])
    assert read == [1]
    np.testing.assert_array_equal(lazy.drift[[0, 47], ::-2], whole[[0, 47], ::-2])
    np.testing.assert_array_equal(lazy.drift[2], whole[2])
    assert float(lazy.drift[9, 9]) == whole[9, 9]
    assert lazy.q.isel(epsilon=3, save=1, component=0).shape == (25,)


def test_an_unfinished_store_is_masked_and_resumed(copy, expected):
    for task in (3, 7):
        record(copy, task).unlink()  # their shards exist: interrupted before the record
    found = dvi.open_sweep(copy)
    assert found.tasks_done == 10
    assert found.status_counts()["not_computed"] == 200
    assert np.isnan(found["drift"][12:16]).all()
    assert (found["status"][28:32] == -1).all()
    np.testing.assert_array_equal(found["drift"][:12], expected["drift"][:12])
    before = record(copy, 2).stat().st_mtime_ns
    same(sweep(copy), expected)
    assert record(copy, 2).stat().st_mtime_ns == before


def test_another_sweep_is_rejected_with_the_differences(copy, monkeypatch):
    with pytest.raises(dvi.StoreMismatch, match=r'args.k: "1.0" there, "2.0" now') as caught:
        sweep(copy, k=2.0)
    assert [d.split(":")[0] for d in caught.value.differing] == ["args.k"]

    def other(t0, t1, q0, p0, q1, p1, args):
        return 2 * sweep_child.hamiltonian(t0, t1, q1, p1, args)

    monkeypatch.setattr(sweep_child, "energy", other)
    with pytest.raises(dvi.StoreMismatch, match=r"observe.drift.function: "):
        sweep(copy)


def in_a_process(path, **env):
    code = (
        "import sweep_child, sys, jax; used = set(); from dvi_jax.sweep import workers as w;"
        "run = w.compute; w.compute = lambda *a: (used.add(a[2].id), run(*a))[1];"
        "found = sweep_child.sweep(sys.argv[1], devices=jax.devices()[-2:]);"
        "print(found.attributes['config_sha256'], jax.device_count(), *sorted(used))"
    )
    out = subprocess.run(
        [sys.executable, "-c", code, str(path)], capture_output=True, text=True, check=True,
        env={**os.environ, "PYTHONPATH": f"{HERE}:{os.environ.get('PYTHONPATH', '')}", **env},
    )  # fmt: skip
    return out.stdout.split()


@pytest.mark.slow
def test_the_identity_is_the_same_in_every_process(finished):
    for seed in ("1", "2"):
        assert in_a_process(finished, PYTHONHASHSEED=seed)[0] == Store.open(finished).sha


@pytest.mark.slow
def test_two_devices_of_three_give_the_bits_of_one(tmp_path, expected):
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=3"
    assert in_a_process(tmp_path / "s.zarr", XLA_FLAGS=flags)[1:] == ["3", "1", "2"]
    same(dvi.open_sweep(tmp_path / "s.zarr"), expected)


def flipped(name, where):
    def damage(path, task):
        file = shard(path, name, task)
        flip(file, int(where * (file.stat().st_size - 1)))

    return damage, f"the shard of {name} has another checksum"


def cut_shard(path, task):
    file = shard(path, "end", task)
    file.write_bytes(file.read_bytes()[:-7])


def with_record(change):
    def damage(path, task):
        record(path, task).write_bytes(change(record(path, task).read_bytes()))

    return damage, "the record is damaged"


def edited_record(change):
    """The checksum of the record is right."""

    def damage(path, task):
        body = json.dumps(change(Store.open(path).record(task))).encode()
        record(path, task).write_bytes(body + f"\n{zlib.crc32(body):08x}\n".encode())

    return damage, "the record is damaged"


OF_SHARDS = (
    flipped("drift", 0), flipped("status", 0.5), flipped("q", 1), flipped("q", random.random()),
    (lambda path, task: shard(path, "p", task).unlink(), "cannot be read"),
    (cut_shard, "the shard of end has [0-9]+ bytes"),
)  # fmt: skip
OF_RECORDS = (
    with_record(lambda text: text[:50]),
    with_record(lambda text: b""),
    with_record(lambda text: b"{}\n0\n"),
    with_record(lambda text: text.replace(b"successful", b"successfuk")),
)
CHANGES = ({"shards": {}}, {"shards": [1]}, {"statuses": {"wonderful": 100}}, {"size": [-3, 25]},
           {"task": 4})  # fmt: skip
EDITED = (
    edited_record(lambda entries: {}),
    edited_record(lambda entries: []),
    *(edited_record(lambda entries, change=change: entries | change) for change in CHANGES),
)


@pytest.mark.parametrize("damages", [(*OF_SHARDS, *OF_RECORDS), EDITED], ids=["files", "edits"])
def test_damage_is_found_and_repaired(copy, expected, damages):
    """One task has each kind of damage; the others are sound."""
    for task, (damage, _) in enumerate(damages):
        damage(copy, task)
    files = [shard(copy, name, task) for name in VARIABLES for task in (10, 11)]
    before = [file.read_bytes() for file in files]
    checked = dvi.open_sweep(copy).verify()
    assert list(checked.bad) == list(range(len(damages)))
    for task, (_, message) in enumerate(damages):
        assert re.search(message, checked.bad[task]), checked.bad[task]
    assert checked.sound + len(damages) == 12 == checked.sound + checked.todo
    assert dvi.open_sweep(copy).status_counts()["not_computed"] == 100 * len(damages)
    same(sweep(copy), expected)
    assert dvi.open_sweep(copy).verify() == (12, {}, 0)
    assert [file.read_bytes() for file in files] == before


def test_damage_is_not_read_as_numbers_without_verification(copy, expected):
    """The codec finds a flipped bit; a missing file counts as not computed."""
    file = shard(copy)
    flip(file, len(file.read_bytes()) // 3)
    with pytest.raises(dvi.StoreError, match=r"drift/c/3/0 is damaged .*verify\(\)"):
        dvi.open_sweep(copy)["drift"]
    file.unlink()
    record(copy, 5).write_bytes(b"")
    found = dvi.open_sweep(copy)
    with pytest.warns(UserWarning, match=r"for 1 of 11 finished tasks, a file .*drift.*same arg"):
        assert found.status_counts()["not_computed"] == 200
    assert (found["status"][12:16] == -1).all()
    assert np.isnan(found["end"][12:16]).all()
    assert (found["status"][:12] != -1).all()
    with pytest.warns(UserWarning, match="computes them again"):
        same(sweep(copy), expected)


def test_a_missing_file_is_not_read_as_results(copy, tmp_path, expected):
    """One file of each kind at a time: metadata, records, shards of each variable, coordinates."""
    of_task = [record(copy), *(shard(copy, name) for name in VARIABLES)]
    others = [*copy.glob("zarr.json"), *copy.glob("*/zarr.json"), *copy.glob("[es]*/c/0"),
              copy / stores.CLAIMS]  # fmt: skip
    refused = {}
    for file in filter(Path.is_file, (*of_task, *others)):
        file.rename(tmp_path / "gone")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # the task lacks a file
                found = dvi.open_sweep(copy)
                computed = found["status"] >= 0
                assert computed.sum() == (1100 if file in of_task else 1200)
                np.testing.assert_array_equal(found["drift"][computed], expected["drift"][computed])
                np.testing.assert_array_equal(found["epsilon"], expected["epsilon"])
        except dvi.StoreError as error:
            refused[file] = str(error)
        (tmp_path / "gone").rename(file)
    assert not refused.keys() & set(of_task)
    assert {f.relative_to(copy).parts[0] for f in refused} == {"epsilon", "start", "zarr.json"}
    assert all(re.search("restore it from|writes it again", said) for said in refused.values())


@pytest.mark.parametrize("damage", [lambda x: x[:20], lambda x: x[:12] + b"?" + x[13:]])
def test_a_damaged_coordinate_is_an_error_and_written_again(copy, damage):
    """One that is missing: the test above."""
    file = copy / "epsilon" / "c" / "0"
    sound = file.read_bytes()
    file.write_bytes(damage(sound))
    with pytest.raises(dvi.StoreError, match=r"the coordinate 'epsilon' .*The same call"):
        dvi.open_sweep(copy)
    sweep(copy)
    assert file.read_bytes() == sound


EDITS = {
    "no length": lambda config, _: config.pop("dims"),
    "negative length": lambda config, _: config["dims"].update(epsilon=-5),
    "huge length": lambda config, _: config["dims"].update(epsilon=10**12),
    "tasks of nothing": lambda config, _: config.update(chunk=[0, 0]),
    "one dimension less": lambda config, _: config.update(chunk=[4]),
    "variables of another kind": lambda config, _: config.update(variables={"drift": 3}),
    "one variable more": lambda config, _: config["variables"].update(x=["float64", [], []]),
    "another shape": lambda _, meta: meta["consolidated_metadata"]["metadata"]["drift"].update(
        shape=[2, 2]
    ),
    "units that are not a table": lambda _, meta: meta["attributes"].update(units="{"),
    "an array": lambda _, meta: meta.update(node_type="array"),
}


def test_an_edited_description_is_an_error_and_loses_nothing(copy):
    """The checksum of the configuration is right each time."""
    meta = copy / "zarr.json"
    sound = meta.read_text()
    for change in EDITS.values():
        content = json.loads(sound)
        config = json.loads(content["attributes"]["config"])
        change(config, content)
        content["attributes"] |= {"config": json.dumps(config), "config_sha256": digest(config)}
        meta.write_text(json.dumps(content))
        with pytest.raises(dvi.StoreError, match=r"zarr\.json .* restore it from a backup"):
            dvi.open_sweep(copy)
    for text, message in (
        (sound.replace('"dvi_jax_sweep": 1', '"dvi_jax_sweep": 99'), "format 99, but must have 1"),
        (sound.replace('\\"k\\"', '\\"K\\"', 1), "config does not match config_sha256"),
        (sound[:100], "does not describe a sweep"),
    ):
        meta.write_text(text)
        with pytest.raises(dvi.StoreError, match=message):
            sweep(copy)
    meta.write_text(sound)
    assert dvi.open_sweep(copy).is_complete


def test_a_lost_description_comes_from_a_new_store_of_the_same_call(copy, tmp_path, expected):
    (copy / "zarr.json").unlink()
    for use in (dvi.open_sweep, sweep):
        with pytest.raises(dvi.StoreError, match=r"lost, .* copy it from a new store"):
            use(copy)

    def stop(progress):
        raise InterruptedError

    with pytest.raises(InterruptedError):
        sweep(tmp_path / "new.zarr", progress=stop)
    shutil.copy(tmp_path / "new.zarr" / "zarr.json", copy)
    same(dvi.open_sweep(copy), expected)


def test_foreign_and_temporary_files(copy):
    """Files of other programs stay, and those that a process may be writing; old ones are removed,
    because the process has died."""
    old, new = (shard(copy).with_name(f".3.{k}.tmp") for k in ("old", "new"))
    names = ("._000000003.json", "notes.json", "000000099.json")
    foreign = [record(copy).with_name(name) for name in names]
    for file in (old, new, *foreign):
        file.write_bytes(record(copy).read_bytes())
    os.utime(old, (1, 1))
    assert dvi.open_sweep(copy).verify() == (12, {}, 0)
    assert [file.exists() for file in (old, new, *foreign)] == [False, True, True, True, True]


SLOW = (("killed", 0, 0), ("killed", 8, 200), ("full", 8, 0))
SLOW = [pytest.param(*x, marks=pytest.mark.slow) for x in SLOW]


@pytest.mark.parametrize(
    ("how", "files", "length"),
    [("killed", 4, 1), ("full", 7, 30), ("permission", 0, 0), *SLOW],
)
def test_a_task_that_ends_at_any_byte_is_computed_again(
    copy, expected, monkeypatch, how, files, length
):
    """Its eight shards are written, then its record."""
    record(copy).unlink()
    with monkeypatch.context() as patched:
        faults.in_write(patched, how, length, after=files)
        with pytest.raises((dvi.StoreError, faults.KilledError)) as caught:
            sweep(copy)
    assert how == "killed" or "repeat the call: it continues" in str(caught.value)
    assert len(list(copy.rglob("*.tmp"))) == (how == "killed")
    found = dvi.open_sweep(copy)
    assert found.tasks_done == 11
    assert (found["status"][12:16] == -1).all()
    same(sweep(copy), expected)
    assert dvi.open_sweep(copy).verify() == (12, {}, 0)


@pytest.mark.parametrize("how", ["full", "killed"])
def test_a_store_that_is_not_completely_made_does_not_exist(tmp_path, monkeypatch, how):
    path = tmp_path / "s.zarr"

    def fail(*_):
        raise faults.KilledError if how == "killed" else OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr(os, "rename", fail)
        if how == "killed":
            patched.setattr(shutil, "rmtree", lambda *_, **__: None)
        with pytest.raises((dvi.StoreError, faults.KilledError), match=r"cannot be made|^$"):
            sweep(path)
    assert not path.exists()
    assert len(list(tmp_path.iterdir())) == (how == "killed")
    if how == "full":
        assert sweep(path).is_complete


def test_a_clock_that_is_set_back_changes_nothing(copy, expected, monkeypatch):
    record(copy).unlink()
    now = itertools.count(2e9, -3600)
    monkeypatch.setattr(time, "time", lambda: next(now))
    same(sweep(copy), expected)
    assert all(r["seconds"] >= 0 for r in dvi.open_sweep(copy).records())


def test_missing_permissions(copy, tmp_path, monkeypatch):
    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as patched:
        patched.setattr(Path, "read_bytes", refuse)
        with pytest.raises(dvi.StoreError, match=r"zarr.json cannot be read \(Permission denied\)"):
            dvi.open_sweep(copy)
    with monkeypatch.context() as patched:
        patched.setattr(os, "access", lambda path, mode: False)
        with pytest.raises(dvi.StoreError, match="cannot be written"):
            sweep(copy)
    (tmp_path / "file").write_text("")
    with pytest.raises(dvi.StoreError, match=r"must be a directory, but .* is a file"):
        sweep(tmp_path / "file" / "s.zarr")


def test_paths_that_are_not_a_store(tmp_path):
    with pytest.raises(dvi.StoreError, match="there is no sweep here"):
        dvi.open_sweep(tmp_path)
    (tmp_path / "thesis.txt").write_text("all of it")
    with pytest.raises(dvi.StoreError, match="is not the store of a sweep"):
        sweep(tmp_path)
    assert (tmp_path / "thesis.txt").read_text() == "all of it"
    for use, path in ((dvi.open_sweep, "a\0b"), (dvi.open_sweep, "x" * 300), (sweep, "y/" * 3000)):
        with pytest.raises(dvi.StoreError, match=r"cannot be the path of a store"):
            use(f"{tmp_path}/{path}")


def test_keys_of_args_that_cannot_be_file_names(tmp_path):
    axes = {name: dvi.Axis("x", [1.0, 2.0]) for name in ("../../x", "k")}
    with pytest.raises(ValueError, match="cannot be the name of an array"):
        dvi.sweep(sweep_child.SYSTEM, [0.0], [1.0], args=axes, h=0.1, num_steps=2, epsilon=0.0,
                  save=dvi.Save(final=True), store=tmp_path / "s.zarr")  # fmt: skip
    assert not list(tmp_path.iterdir())


def test_claims_exclude_threads_and_end_with_the_context(tmp_path):
    file, claim = tmp_path / "claims", claims.claim
    with claim(file, 3) as first, claim(file, 3) as again, claim(file, 4) as other:
        assert (first, again, other) == (True, False, True)
    with claim(file, 3) as later:
        assert later


def child(path, tasks, pause, cache):
    """A process that computes the sweep, with programs that are read from `cache`."""
    limits = {"COMPILE_TIME_SECS": "0", "ENTRY_SIZE_BYTES": "-1"}
    env = {f"JAX_PERSISTENT_CACHE_MIN_{name}": value for name, value in limits.items()}
    env |= {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(cache)}
    command = [sys.executable, str(HERE / "sweep_child.py"), str(path), str(tasks), str(pause)]
    return subprocess.Popen(command, env=env)


def commits(path, what):
    """How often the commit of each task came to its "begin" or "end"."""
    log = Path(f"{path}.log")
    lines = [line.split() for line in log.read_text().splitlines()] if log.exists() else []
    return Counter(number for number, word in lines if word == what)


KILLS = 16


@pytest.mark.slow
def test_killed_many_times(tmp_path):
    """SIGKILL at random moments, two processes at a time: all done, once, with the same bits."""
    path, tasks = tmp_path / "s.zarr", 80

    def start():  # the process that replaces the last killed one computes the rest without pauses
        return child(path, tasks, 0.6 if kills < KILLS else 0.0, tmp_path / "programs")

    # One that is not killed leaves its programs: those below spend no time on compiling them, and
    # none is killed while it writes them.
    assert child(tmp_path / "whole.zarr", tasks, 0.0, tmp_path / "programs").wait(200) == 0
    rng, kills, seen = random.Random(5), 0, 0
    running = [start() for _ in range(2)]
    until = time.monotonic() + 450
    while kills < KILLS and time.monotonic() < until:
        while commits(path, "begin").total() == seen and time.monotonic() < until:
            time.sleep(0.05)
        seen = commits(path, "begin").total()
        time.sleep(rng.uniform(0.0, 0.6))
        i = rng.randrange(2)
        if running[i].poll() is None:
            running[i].send_signal(signal.SIGKILL)
            running[i].wait()
            kills += 1
        running[i] = start()
    assert [process.wait(200) for process in running] == [0, 0]
    found = dvi.open_sweep(path)
    assert found.is_complete
    assert not found.verify().bad
    same(found, sweep(None, tasks))
    assert kills == KILLS
    assert max(commits(path, "end").values()) == 1
    assert len({record["pid"] for record in found.records()}) > 2
    cut_off = commits(path, "begin").total() - commits(path, "end").total()
    assert cut_off > 0, "no kill met a task that was being written: nothing was tested"


def test_observables_without_entries_are_stored(tmp_path):
    """Of shapes (0,), (3, 0) and (0, 2), next to others."""

    def momentum(t, q, p, args):
        return p[0]

    observe = {
        "empty": dvi.Last(lambda q, p: q[:0]),
        "rows": lambda q, p: np.ones((3, 0)) * p[0],
        "columns": dvi.Mean(lambda q, p: np.ones((0, 2)) * p[0]),
        "end": dvi.Last(momentum),
    }
    options = {"q0": [1.0], "p0": dvi.Axis("start", [[0.1], [0.2], [0.3]]), "h": 0.1}
    options |= {"num_steps": 4, "observe": observe, "save": dvi.Save(every=2), "progress": False}
    system = dvi.System(lambda t0, t1, q0, p1, args: p1 @ p1 / 2)
    path = tmp_path / "s.zarr"
    shapes = {"empty": (3, 0), "rows": (3, 3, 3, 0), "columns": (3, 0, 2), "end": (3,)}
    for result in (
        dvi.sweep(system, store=path, **options),
        dvi.sweep(system, store=path, **options),
        dvi.open_sweep(path),
        dvi.sweep(system, **options),
    ):
        assert {name: np.asarray(result[name]).shape for name in shapes} == shapes
        assert np.asarray(result["end"]).tolist() == [0.1, 0.2, 0.3]
    assert dvi.open_sweep(path).verify() == (1, {}, 0)
    with xr.open_zarr(path) as data:
        assert data["rows"].load().shape == shapes["rows"]
