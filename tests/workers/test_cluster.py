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
from potr_cl.formats import load_cameras, load_scene
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
    "best", q=0.3, prune={"keep": 0.4, "iterations": 6}, refit={"at": (0.4,), "steps": 3, "drop": 1e-7}, compact=True,
    between={"views": 0},
)  # fmt: skip


#: The program ``potr-cl``, as patient as the tests are with a scheduler. One that is gone is waited for as long.
PATIENT_PROGRAM = [
    sys.executable, "-c", "import sys; from potr_cl import __main__; from potr_cl.workers import client; "
    "client._CONNECT = 30.0; sys.exit(__main__.main())",
]  # fmt: skip


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


@pytest.fixture(scope="module")
def cluster():
    """Two workers, for the tests that leave them as they were."""
    with local_cluster(2) as cluster:
        yield cluster


def process_of(worker):
    """The number of the process in which a worker of a local cluster runs."""
    return worker.process.process.pid


@pytest.fixture(scope="module")
def scene(data):
    return load_scene(data / "plush_excerpt.ply")


@pytest.fixture(scope="module")
def cameras(data):
    """Five training views, small."""
    chosen = [c for c in load_cameras(data / "plush_excerpt_cameras.json") if c.split == "train"][:5]
    return [small(camera) for camera in chosen]


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
    scene, cameras = street(8, 300, across=True)
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
def test_who_judges_is_killed(scene, device, judged, caplog):
    """One leaves its views to the other, and that one to this computer."""
    coded, views, expected = judged
    with local_cluster(2) as cluster, ClusterPool(cluster.scheduler_address, device) as pool:
        left = [process_of(worker) for worker in cluster.workers.values()]

        def killing_at_once(what, done):
            while done and left:
                os.kill(left.pop(), signal.SIGKILL)

        with Evaluator(device, scene, views, (0, 0, 0), pool) as evaluator, coded.on(device) as candidate:
            assert evaluator.judge(candidate, killing_at_once, coded) == expected
        assert not left
    assert "reassigning its views to" in caplog.text
    assert "continuing on" in caplog.text


@pytest.mark.slow
def test_nobody_waits_for_a_judge_that_stands_still(scene, device, judged, caplog):
    coded, views, expected = judged
    with local_cluster(1) as cluster, ClusterPool(cluster.scheduler_address, device, patience=2.0) as pool:
        (worker,) = cluster.workers.values()
        process = process_of(worker)
        try:
            with Evaluator(device, scene, views, (0, 0, 0), pool) as evaluator, coded.on(device) as candidate:
                began = time.monotonic()
                judge = evaluator.judge(candidate, lambda what, done: done and os.kill(process, signal.SIGSTOP), coded)
                assert judge == expected
            assert time.monotonic() - began < 300
        finally:
            os.kill(process, signal.SIGCONT)
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


def killing(processes, stage, how_many):
    """Progress that kills processes in the middle of a stage."""
    left = list(processes[:how_many])

    def progress(what, done):
        if what == stage and done > 0.3:
            while left:
                os.kill(left.pop(), signal.SIGKILL)

    return progress


@pytest.mark.slow
def test_a_worker_is_killed(scene, cameras, device, expected, caplog):
    with local_cluster(2) as cluster, ClusterPool(cluster.scheduler_address, device) as pool:
        processes = [process_of(worker) for worker in cluster.workers.values()]
        found = encode(scene, cameras, OPTIONS, killing(processes, "refit", 1), device, pool=pool)
    assert found.data == expected
    assert "reassigning its views to" in caplog.text


@pytest.mark.slow
def test_all_workers_are_killed(scene, cameras, device, expected, caplog):
    """This computer goes on alone, and the file is the same."""
    with processes_of_a_cluster(2) as (address, (_, *workers)), ClusterPool(address, device) as pool:
        processes = [worker.pid for worker in workers]
        found = encode(scene, cameras, OPTIONS, killing(processes, "prune", 2), device, pool=pool)
        assert str(device.info) in found.shared.workers[-1]
    assert found.data == expected
    assert caplog.text.count("no worker of the cluster answers any more: continuing on") == 1


@contextlib.contextmanager
def processes_of_a_cluster(workers, without=None, env=None, more=0):
    """A scheduler and workers as users start them; the address, and the processes.

    Args:
        workers: how many.
        without: a folder without the package, in which one more is started.
        env: what is set in the environment of so many more.
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
        all_workers = [started(*worker) for _ in range(workers)] + [started(*worker, **env) for _ in range(more)]
        if without is not None:
            all_workers.append(started(*worker, cwd=without))
        for each in all_workers:
            next(line for line in each.stderr if "Registered to:" in line)
        yield address, [scheduler, *all_workers]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="sends a signal")
@pytest.mark.parametrize(("lost", "how"), [("scheduler", signal.SIGSTOP), ("workers", signal.SIGKILL)])
def test_what_is_printed_when_the_cluster_is_gone(lost, how, tmp_path, data):
    """One line that says so, and that this computer goes on; none of Dask's own."""
    output = tmp_path / "out.potr"
    with processes_of_a_cluster(2) as (address, (scheduler, *workers)):
        command = [
            *PATIENT_PROGRAM, "encode", data / "plush_excerpt.ply", "-o", output, "--cameras",
            data / "plush_excerpt_cameras.json", "--cluster", address, "--iterations", "5000",
            "--keep", "0.001", "--no-quality", "--views-between", "0",
        ]  # fmt: skip
        running = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True)
        try:
            lines = iter(running.stderr.readline, "")
            assert any("prune …" in line for line in lines), "it has ended before pruning"
            time.sleep(1)
            for each in [scheduler] if lost == "scheduler" else workers:
                each.send_signal(how)
            expected = "scheduler does not answer" if lost == "scheduler" else "no worker of the cluster answers"
            # Workers answer without their scheduler, which is missed in the next stage.
            said = next(line for line in lines if not line.lstrip().startswith(("prune", "refit")))
            while "failed (" in said:  # where workers have been missed sooner
                said = next(lines)
            assert expected in said
            assert "continuing on" in said
            running.send_signal(signal.SIGINT)
            _, rest = running.communicate(timeout=300)
        finally:
            running.kill()
            for each in (scheduler, *workers):
                each.send_signal(signal.SIGCONT)
    assert running.returncode == 130
    assert "Traceback" not in rest
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_a_worker_stands_still(scene, cameras, device, expected, monkeypatch, caplog):
    """It is waited for once, not in each stage again."""
    with local_cluster(2) as cluster, ClusterPool(cluster.scheduler_address, device, patience=20.0) as pool:
        worker = next(iter(cluster.workers.values()))
        process, address = process_of(worker), worker.worker_address
        stopped = []

        def progress(what, done):
            if what == "prune" and done > 0.3 and not stopped:
                os.kill(process, signal.SIGSTOP)
                stopped.append(process)

        try:
            found = encode(scene, cameras, OPTIONS, progress, device, pool=pool)
        finally:
            os.kill(process, signal.SIGCONT)
        assert stopped
    assert found.data == expected
    assert caplog.text.count(f"worker {address} failed (it does not answer)") == 1


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
@pytest.mark.skipif(sys.platform == "win32", reason="sends a signal")
def test_nobody_waits_for_ever_in_the_end(device, monkeypatch):
    """For a worker that stands still, though Dask takes it for alive for minutes."""
    with local_cluster(1) as cluster, distributed.Client(cluster, set_as_default=False) as client:
        (worker,) = cluster.workers.values()
        with contextlib.ExitStack() as still:

            def left():
                with ClusterPool(client, device, patience=2.0) as pool, Parts(pool, Idle, [()]) as parts:
                    parts.ready()
                    still.enter_context(standing_still(process_of(worker)))

            leaving = threading.Thread(target=left, daemon=True)
            leaving.start()
            leaving.join(200)
            assert not leaving.is_alive()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="sends a signal")
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
@pytest.mark.skipif(sys.platform == "win32", reason="sends a signal")
def test_ctrl_c_leaves_no_worker_busy(cluster, tmp_path, data, scene, cameras, device, expected):
    output = tmp_path / "out.potr"
    with distributed.Client(cluster, set_as_default=False) as client:
        command = [
            *PATIENT_PROGRAM, "encode", data / "plush_excerpt.ply", "-o", output, "--cameras",
            data / "plush_excerpt_cameras.json", "--cluster", cluster.scheduler_address, "--iterations", "5000",
            "--keep", "0.001", "--no-quality", "--views-between", "0",
        ]  # fmt: skip
        running = subprocess.Popen(command, cwd=ROOT, stderr=subprocess.PIPE, text=True)
        try:
            eventually(lambda: sum(client.run(actors).values()) == 2)
            time.sleep(1)
            running.send_signal(signal.SIGINT)
            _, said = running.communicate(timeout=300)
        finally:
            running.kill()
        assert running.returncode == 130
        assert "interrupted" in said
        assert "Traceback" not in said
        assert not list(tmp_path.iterdir())
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
@pytest.mark.skipif("Intel" not in str(choose_device()), reason="only this runtime can be told the instructions")
def test_other_instructions_under_the_same_name_are_told(device, caplog):
    """As hosts of two generations have; they give other bytes."""
    others = processes_of_a_cluster(0, env={"CL_CONFIG_CPU_TARGET_ARCH": "corei7"}, more=1)
    with others as (address, _), ClusterPool(address, device):
        pass
    assert f"({device.info}, {device.info} with other instructions), which round differently" in caplog.text


@pytest.mark.skipif("Intel" not in str(choose_device()), reason="only this runtime can be told the instructions")
@pytest.mark.slow
def test_who_rounds_differently_or_has_not_the_package_does_no_views(device, caplog, monkeypatch, tmp_path):
    """The file would depend on which views it gets; also where it comes later."""
    monkeypatch.setattr("potr_cl.workers.cluster._NEW", 0.1)
    without = without_the_package(tmp_path)
    others = processes_of_a_cluster(1, without, env={"CL_CONFIG_CPU_TARGET_ARCH": "corei7"}, more=1)
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


def without_the_package(folder):
    """The folder, from which the package cannot be imported."""
    (folder / "potr_cl").mkdir()
    (folder / "potr_cl" / "__init__.py").write_text("raise ModuleNotFoundError('there is none')")
    return folder


@pytest.mark.slow
def test_no_worker_has_this_package(device, tmp_path):
    with processes_of_a_cluster(0, without_the_package(tmp_path)) as (address, _):
        with pytest.raises(UsageError, match="install potr_cl there as it is here, and no other worker") as error:
            ClusterPool(address, device)
        assert "\n" not in str(error.value)


@pytest.mark.slow
def test_a_worker_without_a_device(device):
    with processes_of_a_cluster(0, env={"POTR_CL_DEVICE": "nonsense"}, more=1) as (address, _):
        with pytest.raises(UsageError, match="cannot do the work: no OpenCL device fits 'nonsense'") as error:
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
