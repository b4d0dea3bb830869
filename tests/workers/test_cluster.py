"""A Dask cluster gives the bytes that this computer gives alone, whatever becomes of its workers."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

import potr_cl
from potr_cl.errors import UsageError
from potr_cl.model import splat_groups
from potr_cl.opencl.device import Device
from potr_cl.opencl.discovery import choose_device
from potr_cl.outputs.output import CodedScene
from potr_cl.outputs.potr import Potr
from potr_cl.pipeline.encode import encode
from potr_cl.pipeline.options import EncodeOptions
from potr_cl.quality.evaluator import EvaluationViews, Evaluator
from potr_cl.views import visibility
from potr_cl.workers.cluster import ClusterPool
from potr_cl.workers.parts import Parts
from potr_cl.workers.pool import Part, WorkerLost
from tests.cases.cameras import small
from tests.cases.streets import street

distributed = pytest.importorskip("distributed", reason="needs the extra cluster")

ROOT = Path(__file__).parents[2]
OPTIONS = EncodeOptions.for_preset(
    "best", q=0.3, prune={"keep": 0.4, "iterations": 4}, refit={"at": (0.4,), "steps": 2, "drop": 1e-7}, compact=True,
    between={"views": 0},
)  # fmt: skip

#: The program ``potr-cl``, as patient as the tests are with a scheduler. One that is gone is waited for as long.
PATIENT_PROGRAM = [
    sys.executable, "-c", "import sys; from potr_cl import __main__; from potr_cl.workers import client; "
    "client._CONNECT = 15.0; sys.exit(__main__.main())",
]  # fmt: skip
needs_signals = pytest.mark.skipif(sys.platform == "win32", reason="sends a signal")
needs_intel = pytest.mark.skipif("Intel" not in str(choose_device()), reason="can be told its instructions")
OTHER_INSTRUCTIONS = {"CL_CONFIG_CPU_TARGET_ARCH": "corei7"}


@pytest.fixture(autouse=True)
def patient(monkeypatch):
    """A scheduler that a busy machine has just begun may take long to answer."""
    monkeypatch.setattr("potr_cl.workers.client._CONNECT", 120.0)


@contextlib.contextmanager
def local_cluster(workers):
    with distributed.LocalCluster(
        n_workers=workers, threads_per_worker=1, processes=True, memory_limit=None, dashboard_address=None
    ) as cluster:
        yield cluster


@contextlib.contextmanager
def processes_of_a_cluster(workers=0, *others, without=None):
    """A scheduler and workers as users start them; the address, and the processes.

    Args:
        workers: how many.
        others: what is set in the environment of one more, each.
        without: a folder without the package, in which one more is started.
    """
    with contextlib.ExitStack() as stack:

        def started(*words, cwd=ROOT, **env):
            running = subprocess.Popen(
                [sys.executable, "-m", *words, "--no-dashboard"], cwd=cwd, stderr=subprocess.PIPE, text=True,
                env={**os.environ, "PYTHONPATH": str(cwd), **env},
            )  # fmt: skip
            stack.callback(running.communicate)
            stack.callback(running.kill)
            return running

        scheduler = started("distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0")
        address = next(line for line in scheduler.stderr if "Scheduler at:" in line).split()[-1]
        worker = ("distributed.cli.dask_worker", address, "--nthreads", "1", "--memory-limit", "0", "--no-nanny")
        all_workers = [started(*worker, **env) for env in (*[{}] * workers, *others)]
        if without is not None:
            all_workers.append(started(*worker, cwd=without))
        for each in all_workers:
            next(line for line in each.stderr if "Registered to:" in line)
        yield address, [scheduler, *all_workers]


@contextlib.contextmanager
def long_encode(address, data, folder):
    """The program that encodes for ever by a cluster; it must leave nothing in the folder, and no traceback."""
    command = [
        *PATIENT_PROGRAM, "encode", data / "plush_excerpt.ply", "-o", folder / "out.potr", "--cameras",
        data / "plush_excerpt_cameras.json", "--cluster", address, "--iterations", "5000", "--keep", "0.001",
        "--no-quality", "--views-between", "0",
    ]  # fmt: skip
    running = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True)
    try:
        yield running
        running.send_signal(signal.SIGINT)
        _, said = running.communicate(timeout=300)
    finally:
        running.kill()
    assert running.returncode == 130
    assert "interrupted" in said
    assert "Traceback" not in said
    assert not list(folder.iterdir())


@pytest.fixture(scope="module")
def cluster():
    """Two workers, for the tests that leave them as they were."""
    with local_cluster(2) as cluster:
        yield cluster


@pytest.fixture(scope="module")
def scene(plush_excerpt):
    return plush_excerpt


@pytest.fixture(scope="module")
def cameras(plush_excerpt_cameras):
    """Five training views, small."""
    return [small(c) for c in plush_excerpt_cameras if c.split == "train"][:5]


@pytest.fixture(scope="module")
def device():
    return Device()


@pytest.fixture(scope="module")
def expected(scene, cameras, device):
    return encode(scene, cameras, OPTIONS, device=device).data


def test_the_same_bytes(cluster, scene, cameras, device, expected):
    with ClusterPool(cluster.scheduler_address, device) as pool:
        assert not pool.has(scene)
        found = encode(scene, cameras, OPTIONS, device=device, pool=pool)
        assert pool.has(scene)  # to judge by
        again = encode(scene, cameras, OPTIONS, device=device, pool=pool)
    assert found.data == again.data == expected
    assert found.shared is not None
    assert again.shared is not None
    assert len(found.shared.workers) == 2
    # The scene went there once.
    assert again.shared.sent < found.shared.sent
    with distributed.Client(cluster, set_as_default=False) as client:
        assert potr_cl.encode(scene, cameras, OPTIONS, device=device, cluster=client).data == expected
        # A caller's client stays the caller's.
        assert client.submit(sum, [1, 2]).result(timeout=300) == 3


@pytest.mark.slow
def test_workers_get_what_their_views_see(cluster, device, monkeypatch):
    """And no more of a large scene: the bytes are the same, and fewer travel."""
    monkeypatch.setattr(splat_groups, "LARGEST", 32)
    scene, cameras = street(5, 150, across=True)
    options = dataclasses.replace(OPTIONS, cameras_anyway=True)
    with ClusterPool(cluster.scheduler_address, device) as pool:
        every = encode(scene, cameras, options, device=device, pool=pool)
        monkeypatch.setattr(visibility, "LEAST_SPLATS", 1)
        some = encode(scene, cameras, options, device=device, pool=pool)
    assert some.data == every.data == encode(scene, cameras, options, device=device).data
    assert some.shared is not None
    assert every.shared is not None
    assert some.shared.sent < every.shared.sent - 0.4 * scene.nbytes


@pytest.fixture(scope="module")
def judged(scene, cameras, device):
    """A file, views to judge it by, and how it is judged here."""
    coded = CodedScene(Potr(), encode(scene, None, OPTIONS.changed(prune=False, refit=False, compact=False)).data)
    views = EvaluationViews.of([dataclasses.replace(c, split="test" if k else "train") for k, c in enumerate(cameras)])
    with Evaluator(device, scene, views, (0, 0, 0)) as evaluator, coded.on(device) as candidate:
        return coded, views, evaluator.judge(candidate, lambda what, done: None)


@pytest.mark.slow
def test_the_same_figures(cluster, scene, device, judged, caplog):
    """Workers decode the file; the scene goes to each once, the file each time."""
    coded, views, expected = judged
    with (
        ClusterPool(cluster.scheduler_address, device) as pool,
        Evaluator(device, scene, views, (0, 0, 0), pool) as evaluator,
        coded.on(device) as candidate,
    ):
        assert evaluator.judge(candidate, lambda what, done: None, coded) == expected
        sent = pool.traffic.sent
        assert evaluator.judge(candidate, lambda what, done: None, coded) == expected
    assert 2 * scene.nbytes <= sent < 2 * scene.nbytes + 2 * len(coded.data) + 1000
    assert 2 * len(coded.data) <= pool.traffic.sent - sent < 2 * len(coded.data) + 1000
    assert "reassigning" not in caplog.text


@pytest.mark.slow
@needs_signals
@pytest.mark.parametrize(("how", "count"), [(signal.SIGKILL, 2), (signal.SIGSTOP, 1)])
def test_who_judges_is_lost(scene, device, judged, caplog, how, count):
    """One leaves its views to the other, and that one to this computer; nobody waits for one that stands still."""
    coded, views, expected = judged
    with (
        processes_of_a_cluster(count) as (address, (_, *left)),
        ClusterPool(address, device, patience=2.0) as pool,
        Evaluator(device, scene, views, (0, 0, 0), pool) as evaluator,
        coded.on(device) as candidate,
    ):

        def losing_at_once(what, done):
            while done and left:
                left.pop().send_signal(how)

        assert evaluator.judge(candidate, losing_at_once, coded) == expected
        assert not left
    assert ("reassigning its views to" in caplog.text) >= (count == 2)
    assert "continuing on" in caplog.text


@pytest.mark.slow
def test_scenes_are_compared_by_a_cluster(cluster, scene, cameras, device, judged, tmp_path, monkeypatch):
    """A file that workers get is read once: all judge the same bytes, whoever writes to it meanwhile."""
    coded, _, _ = judged
    path, opened, plainly = tmp_path / "b.potr", [], Path.open
    path.write_bytes(coded.data)
    alone = potr_cl.compare(scene, path, cameras, device=device)

    def noted(self, *args, **keywords):
        if self == path:
            opened.append(self)
        return plainly(self, *args, **keywords)

    monkeypatch.setattr(Path, "open", noted)
    for a, b in ((scene, path), (coded.data, scene)):
        found = potr_cl.compare(a, b, cameras, device=device, cluster=cluster.scheduler_address)
        assert found.psnr == alone.psnr
        assert [view.figures["b_against_a"].psnr for view in found.figures.views] == [
            view.figures["b_against_a"].psnr for view in alone.figures.views
        ]
    assert len(opened) == 2  # for its first bytes, which tell what it is, and whole


@pytest.mark.slow
@needs_signals
@pytest.mark.parametrize(
    ("stage", "how", "count", "said"),
    [
        ("refit", signal.SIGKILL, 1, "reassigning its views to"),
        ("prune", signal.SIGKILL, 2, "no worker of the cluster answers any more: continuing on"),
        ("prune", signal.SIGSTOP, 1, "failed (it does not answer)"),  # waited for once, not in each stage again
    ],
)
def test_workers_are_lost(scene, cameras, device, expected, caplog, stage, how, count, said):
    """In the middle of a stage; without any, this computer goes on alone, and the file is the same."""
    with processes_of_a_cluster(2) as (address, (_, *workers)), ClusterPool(address, device, patience=10.0) as pool:
        left = workers[:count]

        def losing(what, done):
            while what == stage and done > 0.3 and left:
                left.pop().send_signal(how)

        found = encode(scene, cameras, OPTIONS, losing, device, pool=pool)
        assert not left
    assert found.data == expected
    assert caplog.text.count(said) == 1
    if count == 2:
        assert str(device.info) in found.shared.workers[-1]


@pytest.mark.slow
@needs_signals
@pytest.mark.parametrize(
    ("how", "expected"),
    [(signal.SIGSTOP, "scheduler does not answer"), (signal.SIGKILL, "no worker of the cluster answers")],
)
def test_what_is_printed_when_the_cluster_is_gone(how, expected, tmp_path, data):
    """One line that says so, and that this computer goes on; none of Dask's own."""
    with processes_of_a_cluster(2) as (address, (scheduler, *workers)), long_encode(address, data, tmp_path) as running:
        lines = iter(running.stderr.readline, "")
        assert any("prune …" in line for line in lines), "it has ended before pruning"
        time.sleep(1)
        for each in [scheduler] if how == signal.SIGSTOP else workers:
            each.send_signal(how)
        # Workers answer without their scheduler, which is missed in the next stage.
        said = next(line for line in lines if not line.lstrip().startswith(("prune", "refit")))
        while "failed (" in said:  # where workers have been missed sooner
            said = next(lines)
        assert expected in said
        assert "continuing on" in said


@contextlib.contextmanager
def standing_still(process):
    os.kill(process, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(process, signal.SIGCONT)


class Idle(Part):
    """Does nothing."""

    def __init__(self, device, memory):
        pass

    def close(self):
        pass


@pytest.mark.slow
@needs_signals
def test_nobody_waits_for_ever_in_the_end(device):
    """For a worker that stands still, though Dask takes it for alive for minutes."""
    with (
        processes_of_a_cluster(1) as (address, (_, worker)),
        distributed.Client(address, set_as_default=False) as client,
        contextlib.ExitStack() as still,
    ):

        def left():
            with ClusterPool(client, device, patience=2.0) as pool, Parts(pool, Idle, [()]) as parts:
                parts.ready()
                still.enter_context(standing_still(worker.pid))

        leaving = threading.Thread(target=left, daemon=True)
        leaving.start()
        leaving.join(200)
        assert not leaving.is_alive()


@pytest.mark.slow
@needs_signals
def test_a_scheduler_that_stands_still_is_told(device, monkeypatch, caplog):
    """Also where nobody asks it anything: the workers answer without it."""
    monkeypatch.setattr("potr_cl.workers.cluster._WHO", 1.0)
    with processes_of_a_cluster(1) as (address, (scheduler, _)), ClusterPool(address, device) as pool:
        (there,) = pool.workers()
        with standing_still(scheduler.pid), Parts(pool, Idle, [()]) as parts:
            eventually(lambda: there.lost)
            parts.tell("close")
        (here,) = pool.workers()
        assert str(device.info) in here.name
    assert caplog.text.count("scheduler does not answer any more: continuing on") == 1
    assert "gave up" not in caplog.text


def actors(dask_worker):
    """On a worker: how many actors there are."""
    return len(dask_worker.state.actors)


def eventually(check, seconds=300):
    end = time.monotonic() + seconds
    while not check():
        assert time.monotonic() < end, "it does not come to pass"
        time.sleep(0.1)


@pytest.mark.slow
@needs_signals
def test_ctrl_c_leaves_no_worker_busy(cluster, tmp_path, data, scene, cameras, device, expected):
    with distributed.Client(cluster, set_as_default=False) as client:
        with long_encode(cluster.scheduler_address, data, tmp_path):
            eventually(lambda: sum(client.run(actors).values()) == 2)
            time.sleep(1)
        eventually(lambda: sum(client.run(actors).values()) == 0)
        # Nothing that was taken for it stays taken, and the workers are free for others.
        eventually(lambda: set(client.run(taken).values()) == {0})
        assert potr_cl.encode(scene, cameras, OPTIONS, device=device, cluster=client).data == expected


def taken():
    """On a worker: bytes of its devices that somebody has."""
    from potr_cl.workers import actor

    return sum(device.allocated for device in actor.opened.values())


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("nonsense", "no Dask scheduler answers at 'nonsense'"),
        ("", "--cluster is empty"),
        ("tcp://[[:x", "no Dask scheduler answers"),
        ("tcp://127.0.0.1:0", "no Dask scheduler answers"),
        (7, "address of a Dask scheduler"),
    ],
)
def test_no_cluster_there(address, said, device, monkeypatch):
    monkeypatch.setattr("potr_cl.workers.client._CONNECT", 0.5)
    with pytest.raises(UsageError, match=said) as error:
        ClusterPool(address, device)
    assert "\n" not in str(error.value)


def test_a_cluster_without_workers(device, monkeypatch, caplog):
    monkeypatch.setattr("potr_cl.workers.cluster._COME", 0.5)
    with local_cluster(0) as cluster, pytest.raises(UsageError, match="has no worker"):
        ClusterPool(cluster.scheduler_address, device)
    assert "the cluster has no worker yet: waiting" in caplog.text


@pytest.mark.slow
def test_workers_may_come_later(scene, cameras, device, expected, monkeypatch, caplog):
    """The first one is waited for; another one gets views from the next stage on."""
    monkeypatch.setattr("potr_cl.workers.cluster._NEW", 0.1)
    with local_cluster(0) as cluster:
        threading.Timer(1, cluster.scale, (1,)).start()
        with ClusterPool(cluster.scheduler_address, device) as pool:
            assert len(pool.workers()) == 1
            cluster.scale(2)
            eventually(lambda: len(pool.workers()) == 2)
            assert "joined; it gets views" in caplog.text
            assert encode(scene, cameras, OPTIONS, device=device, pool=pool).data == expected


@pytest.mark.slow
def test_nobody_of_a_computer_is_asked_again_where_one_was_lost_as_it_was_met(device, monkeypatch, caplog):
    monkeypatch.setattr("potr_cl.workers.cluster._NEW", 0.05)
    asked = []

    def lost(worker):
        asked.append(worker.name)
        raise WorkerLost(f"{worker.name} has gone")

    with local_cluster(1) as cluster, ClusterPool(cluster.scheduler_address, device) as pool:
        monkeypatch.setattr("potr_cl.workers.actor.ClusterWorker.meet", lost)
        cluster.scale(2)
        eventually(lambda: asked)
        cluster.scale(3)
        eventually(lambda: len(cluster.scheduler_info["workers"]) == 3)
        time.sleep(0.5)
        assert len(asked) == 1
        assert len(pool.workers()) == 1
    assert caplog.text.count("ignoring this worker") == 1


@pytest.mark.slow
def test_devices_of_several_kinds_are_told(cluster, device, monkeypatch, caplog):
    other = SimpleNamespace(family=device.family, info="another device", digits=device.digits)
    with ClusterPool(cluster.scheduler_address, other):
        pass
    assert "there are devices of several kinds ('" in caplog.text
    assert "another device" in caplog.text
    caplog.clear()
    with ClusterPool(cluster.scheduler_address, device):
        assert not caplog.text


@pytest.mark.slow
@needs_intel
def test_other_instructions_under_the_same_name_are_told(device, caplog):
    """As hosts of two generations have; they give other bytes."""
    with processes_of_a_cluster(0, OTHER_INSTRUCTIONS) as (address, _), ClusterPool(address, device):
        pass
    assert f"({device.info}, {device.info} with other instructions), which round differently" in caplog.text


@pytest.fixture
def without_the_package(tmp_path):
    """A folder from which the package cannot be imported."""
    (tmp_path / "potr_cl").mkdir()
    (tmp_path / "potr_cl" / "__init__.py").write_text("raise ModuleNotFoundError('there is none')")
    return tmp_path


@pytest.mark.slow
@needs_intel
def test_who_rounds_differently_or_has_not_the_package_does_no_views(device, caplog, monkeypatch, without_the_package):
    """The file would depend on which views it gets; also where it comes later."""
    monkeypatch.setattr("potr_cl.workers.cluster._NEW", 0.1)
    others = processes_of_a_cluster(1, OTHER_INSTRUCTIONS, without=without_the_package)
    with others as (address, _), ClusterPool(address, device) as pool:
        (same,) = pool.workers()
        assert same.digits == device.digits()
        assert caplog.text.count("rounds differently from the others") == 1
        assert "several kinds" not in caplog.text
        assert "ignoring this worker" in caplog.text
        assert len(pool._refused) == 2
        (differing,) = [name for name in pool._refused if f"worker {name} (" in caplog.text]
        pool._refused.discard(differing)  # as if it were another one
        eventually(lambda: differing in pool._refused)
        assert pool.workers() == [same]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lacks", "said"),
    [
        ("package", "install potr_cl there as it is here, and no other worker"),
        ("device", "cannot do the work: no OpenCL device fits 'nonsense'"),
    ],
)
def test_no_worker_can_do_the_work(device, lacks, said, without_the_package):
    others = (
        processes_of_a_cluster(without=without_the_package)
        if lacks == "package"
        else processes_of_a_cluster(0, {"POTR_CL_DEVICE": "nonsense"})
    )
    with others as (address, _):
        with pytest.raises(UsageError, match=said) as error:
            ClusterPool(address, device)
        assert "\n" not in str(error.value)


def test_several_devices_and_a_cluster(scene, cameras, device):
    with pytest.raises(UsageError, match="several devices and a cluster"):
        potr_cl.encode(scene, cameras, device=[device, Device()], cluster="tcp://127.0.0.1:1")


@pytest.mark.slow
def test_another_version_is_refused(cluster, device, monkeypatch):
    monkeypatch.setattr(potr_cl, "__version__", "0.0.0")
    with pytest.raises(UsageError, match=r"this computer 0\.0\.0: install the same"):
        ClusterPool(cluster.scheduler_address, device)
