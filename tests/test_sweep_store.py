"""The store of sweeps: resuming, dying at any moment, damage of every kind."""

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


@pytest.fixture(scope="module")
def undisturbed():
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


@pytest.mark.slow
def test_a_store_has_the_bits_of_memory(undisturbed, finished):
    found = dvi.open_sweep(finished)
    assert found.is_complete
    same(found, undisturbed)
    assert found.status_counts() == undisturbed.status_counts()
    assert found.status_counts() == {"successful": 1175, "not_finite": 25}
    a, b = found.to_xarray(), undisturbed.to_xarray()
    xr.testing.assert_identical(a.drop_attrs(), b.drop_attrs())
    for key in ("host", "jax", "created", "git_revision", "config"):
        assert isinstance(a.attrs[key], str)


@pytest.mark.slow
def test_other_programs_read_it(undisturbed, finished):
    with xr.open_zarr(finished, chunks=None) as ds:
        assert ds.drift.dims == ("epsilon", "start")
        assert ds.sel(start=3).status.attrs["flag_meanings"].startswith("not_computed successful")
        np.testing.assert_array_equal(ds.drift, undisturbed["drift"])
        assert "q0" in ds.coords


@pytest.mark.slow
def test_parts_are_read_without_the_rest(finished, monkeypatch):
    lazy = dvi.open_sweep(finished).to_xarray()
    asked = []
    read = Store.record
    monkeypatch.setattr(Store, "record", lambda self, n: asked.append(n) or read(self, n))
    whole = sweep(None)["drift"]
    np.testing.assert_array_equal(lazy.drift[4:8, 3], whole[4:8, 3])
    assert asked == [1]
    np.testing.assert_array_equal(lazy.drift[[0, 47], ::-2], whole[[0, 47], ::-2])
    np.testing.assert_array_equal(lazy.drift[2], whole[2])
    assert float(lazy.drift[9, 9]) == whole[9, 9]
    assert lazy.q.isel(epsilon=3, save=1, component=0).shape == (25,)


def test_an_unfinished_store_is_masked_and_goes_on(copy, undisturbed):
    for task in (3, 7):
        record(copy, task).unlink()  # their shards are still there: cut off before the record
    found = dvi.open_sweep(copy)
    assert found.tasks_done == 10
    assert found.status_counts()["not_computed"] == 200
    assert np.isnan(found["drift"][12:16]).all()
    assert (found["status"][28:32] == -1).all()
    np.testing.assert_array_equal(found["drift"][:12], undisturbed["drift"][:12])
    before = record(copy, 2).stat().st_mtime_ns
    same(sweep(copy), undisturbed)
    assert record(copy, 2).stat().st_mtime_ns == before


def test_another_sweep_is_refused_with_what_differs(copy):
    with pytest.raises(dvi.StoreMismatch, match=r'args.k: "1.0" there, "2.0" now') as caught:
        sweep(copy, k=2.0)
    assert [d.split(":")[0] for d in caught.value.differing] == ["args.k"]


def test_a_number_within_a_function_is_seen(copy, monkeypatch):
    def other(t0, t1, q0, p0, q1, p1, args):
        return 2 * sweep_child.hamiltonian(t0, t1, q1, p1, args)

    monkeypatch.setattr(sweep_child, "energy", other)
    with pytest.raises(dvi.StoreMismatch, match=r"observe.drift.function: "):
        sweep(copy)


@pytest.mark.slow
def test_the_identity_is_the_same_in_every_process(tmp_path, finished):
    code = (
        "import sweep_child, sys; print(sweep_child.sweep(sys.argv[1]).attributes['config_sha256'])"
    )
    for seed in ("1", "2"):
        found = subprocess.run(
            [sys.executable, "-c", code, str(finished)], capture_output=True, text=True, check=True,
            env={**os.environ, "PYTHONHASHSEED": seed, "PYTHONPATH": str(Path(__file__).parent)},
        )  # fmt: skip
        assert found.stdout.strip() == Store.open(finished).sha


def flip(path: Path, where: int):
    content = bytearray(path.read_bytes())
    content[where] ^= 1
    path.write_bytes(content)


SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("status", "q")]


@pytest.mark.parametrize("name", ["drift", *SLOW])
@pytest.mark.slow
def test_every_flipped_bit_is_found_and_repaired(copy, undisturbed, name):
    file = shard(copy, name)
    whole = file.read_bytes()
    for where in {0, len(whole) // 2, len(whole) - 1, random.randrange(len(whole))}:
        flip(file, where)
        checked = dvi.open_sweep(copy).verify()
        assert checked.bad == {3: f"the shard of {name} has another checksum"}
        assert (checked.sound, checked.todo) == (11, 1)
        same(sweep(copy), undisturbed)
        assert file.read_bytes() == whole
    assert not dvi.open_sweep(copy).verify().bad


def test_a_flipped_bit_does_not_pass_for_a_number(copy):
    """Whoever reads without verifying is told by the codec."""
    file = shard(copy)
    flip(file, len(file.read_bytes()) // 3)
    with pytest.raises(dvi.StoreError, match=r"drift/c/3/0: is damaged .*verify\(\)"):
        dvi.open_sweep(copy)["drift"]


@pytest.mark.parametrize("damage", ["cut", "empty", "rubbish", "flip"])
def test_a_damaged_record_is_a_task_to_do(copy, undisturbed, damage):
    file = record(copy)
    text = file.read_bytes()
    if damage == "flip":
        flip(file, 40)
    else:
        file.write_bytes({"cut": text[:50], "empty": b"", "rubbish": b"{}\n0\n"}[damage])
    assert dvi.open_sweep(copy).tasks_done == 11
    assert dvi.open_sweep(copy).verify().bad == {3: "the record is damaged"}
    same(sweep(copy), undisturbed)


def test_a_missing_or_short_shard_is_found(copy, undisturbed):
    shard(copy, "p", 1).unlink()
    file = shard(copy, "end", 2)
    file.write_bytes(file.read_bytes()[:-7])
    bad = dvi.open_sweep(copy).verify().bad
    assert set(bad) == {1, 2}
    assert "cannot be read" in bad[1]
    assert "bytes" in bad[2]
    same(sweep(copy), undisturbed)


def test_a_removed_shard_is_not_computed_and_computed_again(copy, undisturbed):
    shard(copy, "drift", 3).unlink()
    found = dvi.open_sweep(copy)
    with pytest.warns(UserWarning, match=r"1 of the finished tasks lack a file .*drift"):
        assert not found.is_complete
    with pytest.warns(UserWarning, match="the same call"):
        assert found.status_counts()["not_computed"] == 100
    assert (found["status"][12:16] == -1).all()
    assert np.isnan(found["end"][12:16]).all()
    assert (found["status"][:12] != -1).all()
    with pytest.warns(UserWarning, match="computes them again"):
        same(sweep(copy), undisturbed)
    assert dvi.open_sweep(copy).is_complete


@pytest.mark.slow
def test_a_full_disk_loses_nothing(tmp_path, undisturbed, monkeypatch):
    path, written = tmp_path / "s.zarr", []
    write = os.fsync

    def full(handle):
        written.append(handle)
        if len(written) > 200:
            raise OSError(28, "No space left on device")
        write(handle)

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(dvi.StoreError, match=r"No space left on device.*the same call goes on"):
        sweep(path)
    monkeypatch.undo()
    found = dvi.open_sweep(path)
    assert 0 < found.tasks_done < 12
    assert not found.verify().bad
    assert not list(path.rglob("*.tmp"))
    same(sweep(path), undisturbed)


@pytest.mark.parametrize(
    ("how", "files", "length"),
    [
        ("killed", 0, 0),
        ("killed", 4, 1),
        ("killed", 8, 200),
        ("full", 7, 30),
        ("full", 8, 0),
        ("permission", 0, 0),
    ],
)
def test_a_task_that_ends_at_any_byte_is_done_again(
    copy, undisturbed, monkeypatch, how, files, length
):
    """Its eight shards are written, then its record."""
    record(copy).unlink()
    with monkeypatch.context() as patched:
        faults.in_write(patched, how, length, after=files)
        with pytest.raises((dvi.StoreError, faults.KilledError)) as caught:
            sweep(copy)
    assert how == "killed" or "the same call goes on" in str(caught.value)
    assert len(list(copy.rglob("*.tmp"))) == (how == "killed")
    found = dvi.open_sweep(copy)
    assert found.tasks_done == 11
    assert (found["status"][12:16] == -1).all()
    same(sweep(copy), undisturbed)
    assert dvi.open_sweep(copy).verify() == (12, {}, 0)


@pytest.mark.parametrize("how", ["full", "killed"])
def test_a_store_that_is_not_made_to_its_end_is_not_there(tmp_path, monkeypatch, how):
    path = tmp_path / "s.zarr"
    errors = {"full": OSError(28, "No space left on device"), "killed": faults.KilledError()}
    with monkeypatch.context() as patched:

        def fail(*_):
            raise errors[how]

        patched.setattr(os, "rename", fail)
        if how == "killed":
            patched.setattr(shutil, "rmtree", lambda *_, **__: None)
        with pytest.raises((dvi.StoreError, faults.KilledError), match=r"cannot be made|^$"):
            sweep(path)
    assert not path.exists()
    assert len(list(tmp_path.iterdir())) == (how == "killed")
    assert sweep(path).is_complete


def test_verify_clears_away_what_dead_processes_had_begun(copy):
    old, new = (shard(copy).with_name(f".3.{k}.tmp") for k in ("old", "new"))
    for file in (old, new):
        file.write_bytes(b"some of it")
    os.utime(old, (1, 1))
    assert dvi.open_sweep(copy).verify() == (12, {}, 0)
    assert not old.exists()
    assert new.exists()  # another process may be writing it


def test_no_removed_file_is_taken_for_results(copy, tmp_path, undisturbed):
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
                for name in ("drift", "end", "failed_step"):
                    np.testing.assert_array_equal(
                        found[name][computed], undisturbed[name][computed]
                    )
                np.testing.assert_array_equal(found["epsilon"], undisturbed["epsilon"])
        except dvi.StoreError as error:
            refused[file] = str(error)
        (tmp_path / "gone").rename(file)
    assert not refused.keys() & set(of_task)
    assert {f.relative_to(copy).parts[0] for f in refused} == {"epsilon", "start", "zarr.json"}
    assert all(re.search("Restore the file|writes it again", said) for said in refused.values())


def test_a_clock_that_is_set_back_changes_nothing(copy, undisturbed, monkeypatch):
    record(copy).unlink()
    now = itertools.count(2e9, -3600)
    monkeypatch.setattr(time, "time", lambda: next(now))
    same(sweep(copy), undisturbed)
    assert all(r["seconds"] >= 0 for r in dvi.open_sweep(copy).records())


def test_a_description_that_may_not_be_read(copy, monkeypatch):
    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "read_text", refuse)
    with pytest.raises(dvi.StoreError, match=r"zarr.json cannot be read \(Permission denied\)"):
        dvi.open_sweep(copy)


def test_a_directory_that_cannot_be_written(copy, tmp_path, monkeypatch):
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    with pytest.raises(dvi.StoreError, match="cannot be written"):
        sweep(copy)
    monkeypatch.undo()
    (tmp_path / "file").write_text("")
    with pytest.raises(dvi.StoreError, match="cannot be made"):
        sweep(tmp_path / "file" / "s.zarr")


def test_what_is_no_store(tmp_path, copy):
    with pytest.raises(dvi.StoreError, match="there is no sweep here"):
        dvi.open_sweep(tmp_path)
    (tmp_path / "thesis.txt").write_text("all of it")
    with pytest.raises(dvi.StoreError, match="is no sweep"):
        sweep(tmp_path)
    assert (tmp_path / "thesis.txt").read_text() == "all of it"
    meta = copy / "zarr.json"
    text = meta.read_text()
    meta.write_text(text.replace('\\"k\\"', '\\"K\\"', 1))
    with pytest.raises(dvi.StoreError, match="damaged or was edited"):
        dvi.open_sweep(copy)
    meta.write_text(text[:100])
    with pytest.raises(dvi.StoreError, match="cannot be read as that of a sweep"):
        sweep(copy)


@pytest.mark.parametrize("path", ["a\0b", "x" * 300, "y/" * 3000])
def test_a_path_that_no_directory_can_have(path, tmp_path):
    for use in (dvi.open_sweep, sweep):
        with pytest.raises(
            dvi.StoreError, match=r"cannot be the path of a store .*: give the path"
        ):
            use(f"{tmp_path}/{path}")


@pytest.mark.parametrize("key", ["../../x", "a/b"])
def test_a_key_of_args_that_no_file_can_have(key, tmp_path):
    axes = {name: dvi.Axis("x", [1.0, 2.0]) for name in (key, "k")}
    with pytest.raises(ValueError, match="cannot be the name of an array in a store"):
        dvi.sweep(
            sweep_child.SYSTEM, [0.0], [1.0], args=axes, h=0.1, num_steps=2,
            save=dvi.Save(final=True), store=tmp_path / "s.zarr",
        )  # fmt: skip
    assert not list(tmp_path.iterdir())


def test_foreign_files_among_the_records_are_left_alone(copy):
    folder = record(copy).parent
    foreign = [folder / name for name in ("._000000003.json", "notes.json", "000000099.json")]
    for file in foreign:
        file.write_bytes(record(copy).read_bytes())
    assert dvi.open_sweep(copy).verify() == (12, {}, 0)
    assert sweep(copy).is_complete
    assert all(file.exists() for file in foreign)


def edited(path, change):
    """Change the description of a store and its configuration, whose checksum becomes right."""
    meta = path / "zarr.json"
    content = json.loads(meta.read_text())
    config = json.loads(content["attributes"]["config"])
    change(config, content)
    content["attributes"] |= {"config": json.dumps(config), "config_sha256": digest(config)}
    meta.write_text(json.dumps(content))


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
    "units that are no table": lambda _, meta: meta["attributes"].update(units="{"),
    "an array": lambda _, meta: meta.update(node_type="array"),
}


@pytest.mark.parametrize("change", EDITS.values(), ids=EDITS.keys())
def test_an_edited_description_is_refused_and_loses_nothing(copy, tmp_path, change):
    sound = (copy / "zarr.json").read_text()
    edited(copy, change)
    with pytest.raises(dvi.StoreError, match=r"zarr\.json .*edited.* Restore the file"):
        dvi.open_sweep(copy)
    (copy / "zarr.json").write_text(sound)
    assert dvi.open_sweep(copy).is_complete


@pytest.mark.parametrize(
    "change",
    [
        lambda found: {},
        lambda found: [],
        lambda found: found | {"shards": {}},
        lambda found: found | {"shards": [1]},
        lambda found: found | {"statuses": {"wonderful": 100}},
        lambda found: found | {"size": [-3, 25]},
        lambda found: found | {"task": 4},
    ],
)
def test_an_edited_record_is_a_task_to_do(copy, change):
    file = record(copy)
    body = json.dumps(change(Store.open(copy).record(3))).encode()
    file.write_bytes(body + f"\n{zlib.crc32(body):08x}\n".encode())
    found = dvi.open_sweep(copy)
    assert found.tasks_done == 11
    assert found.status_counts()["not_computed"] == 100
    assert found.verify().bad == {3: "the record is damaged"}


@pytest.mark.parametrize("damage", ["removed", "cut", "flipped"])
def test_a_damaged_coordinate_is_never_a_number_and_written_again(copy, undisturbed, damage):
    file = copy / "epsilon" / "c" / "0"
    if damage == "removed":
        file.unlink()
    elif damage == "cut":
        file.write_bytes(file.read_bytes()[:20])
    else:
        flip(file, 12)
    with pytest.raises(dvi.StoreError, match=r"the coordinate 'epsilon' .*The same call of dvi"):
        dvi.open_sweep(copy)
    same(sweep(copy), undisturbed)
    np.testing.assert_array_equal(dvi.open_sweep(copy)["epsilon"], undisturbed["epsilon"])


def test_a_lost_description_comes_from_a_new_store_of_the_same_call(copy, tmp_path, undisturbed):
    (copy / "zarr.json").unlink()
    for use in (dvi.open_sweep, sweep):
        with pytest.raises(dvi.StoreError, match=r"was lost\. Restore the file .*copy it from"):
            use(copy)

    def stop(progress):
        raise InterruptedError

    with pytest.raises(InterruptedError):
        sweep(tmp_path / "new.zarr", progress=stop)
    shutil.copy(tmp_path / "new.zarr" / "zarr.json", copy)
    found = dvi.open_sweep(copy)
    assert found.is_complete
    same(found, undisturbed)


def test_a_store_of_another_format(copy):
    meta = copy / "zarr.json"
    content = json.loads(meta.read_text())
    content["attributes"]["dvi_jax_sweep"] = 99
    meta.write_text(json.dumps(content))
    with pytest.raises(dvi.StoreError, match="format 99, this version reads 1"):
        dvi.open_sweep(copy)


def test_claims_exclude_threads_and_end_with_the_context(tmp_path):
    file = tmp_path / "claims"
    claim = claims.claim
    with claim(file, 3) as first, claim(file, 3) as again, claim(file, 4) as other:
        assert (first, again, other) == (True, False, True)
    with claim(file, 3) as later:
        assert later


def child(path, tasks, pause=0.01, cache=None):
    """A process of its own; with `cache`, programs are read from there in place of compiled."""
    script = Path(__file__).with_name("sweep_child.py")
    env = dict(os.environ)
    if cache is not None:
        env |= {
            "JAX_COMPILATION_CACHE_DIR": str(cache),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
        }
    return subprocess.Popen(
        [sys.executable, str(script), str(path), str(tasks), str(pause)], env=env
    )


def committed(path):
    lines = [line.split() for line in Path(f"{path}.log").read_text().splitlines()]
    return Counter(n for n, what in lines if what == "end")


def words(path):
    log = Path(f"{path}.log")
    return [line.split()[1] for line in log.read_text().splitlines()] if log.exists() else []


def begun(path):
    """Commits that have begun."""
    return words(path).count("begin")


def cut_off(path):
    """Commits that had begun and never ended."""
    return words(path).count("begin") - words(path).count("end")


@pytest.mark.slow
def test_two_devices_give_the_bits_of_one(tmp_path, undisturbed):
    code = "import sweep_child, sys, jax; sweep_child.sweep(sys.argv[1]); print(jax.device_count())"
    flags = f"{os.environ['XLA_FLAGS']} --xla_force_host_platform_device_count=2"
    out = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path / "s.zarr")], capture_output=True, text=True,
        check=True,
        env={**os.environ, "XLA_FLAGS": flags, "PYTHONPATH": str(Path(__file__).parent)},
    )  # fmt: skip
    assert out.stdout.strip() == "2"
    same(dvi.open_sweep(tmp_path / "s.zarr"), undisturbed)


@pytest.mark.slow
def test_two_processes_on_one_store(tmp_path):
    path = tmp_path / "s.zarr"
    running = [child(path, 30, 0.5), child(path, 30, 0.5)]
    assert [p.wait(120) for p in running] == [0, 0]
    assert set(committed(path).values()) == {1}
    assert len(committed(path)) == 30
    by = Counter(Store.open(path).record(i)["pid"] for i in range(30))
    assert len(by) == 2
    same(dvi.open_sweep(path), sweep(None, 30))


KILLS = 16


@pytest.mark.slow
def test_killed_many_times(tmp_path):
    """SIGKILL at random moments, two processes at a time: all done, once, with the same bits."""
    path, tasks = tmp_path / "s.zarr", 80

    def start():  # who takes the place of the last one killed does the rest without pauses
        return child(path, tasks, 0.6 if kills < KILLS else 0.0, tmp_path / "programs")

    # One that is not killed leaves its programs, so that of those below no time goes into
    # compiling them once more and nobody is killed while he writes them.
    assert child(tmp_path / "whole.zarr", tasks, 0.0, tmp_path / "programs").wait(200) == 0
    rng, kills, seen = random.Random(5), 0, 0
    running = [start() for _ in range(2)]
    until = time.monotonic() + 450
    while kills < KILLS and time.monotonic() < until:
        while begun(path) == seen and time.monotonic() < until:  # somebody is at work
            time.sleep(0.05)
        seen = begun(path)
        time.sleep(rng.uniform(0.0, 0.6))
        i = rng.randrange(2)
        if running[i].poll() is None:
            running[i].send_signal(signal.SIGKILL)
            running[i].wait()
            kills += 1
        running[i] = start()
    for process in running:
        assert process.wait(200) == 0
    found = dvi.open_sweep(path)
    assert found.is_complete
    assert not found.verify().bad
    same(found, sweep(None, tasks))  # whose programs this process has compiled
    assert kills == KILLS
    assert max(committed(path).values()) == 1
    assert cut_off(path) > 0, "no kill met a task that was being written: nothing was tested"
