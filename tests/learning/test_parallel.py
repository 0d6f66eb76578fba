"""Several seeds and several devices: the same numbers however they are spread."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from beginnings import begun_seeds
from trajectories import TINY_TASK, tiny_learner

from sumajax.learning import parallel

SEEDS = [0, 5]
PIECES = Path("/proc/self/maps")

COMPILED = "/jax/core/compile/backend_compile_duration"
events = []
jax.monitoring.register_event_duration_secs_listener(
    lambda event, seconds, **_: events.append(event) if event == COMPILED else None
)


def programs_compiled():
    """Or read from the cache of compiled programs, in this process so far."""
    return len(events)


def raw(leaf):
    """Keys as numbers."""
    key = jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)
    return np.asarray(jax.random.key_data(leaf) if key else leaf)


def test_several_seeds_are_each_alone():
    """In one program, one after the other, as if the others were not there, nor their critics."""
    learner = tiny_learner(TINY_TASK, num_envs=200, rollout_length=20, critic="state")
    mesh = parallel.make_mesh(len(SEEDS), 200, devices=1)
    states = parallel.place(parallel.init_seeds(learner, SEEDS), mesh)
    states, metrics = parallel.make_train(learner, mesh, epochs=1)(states)
    assert metrics.env_steps.shape == (len(SEEDS), 1)
    for i, seed in enumerate(SEEDS):
        alone = learner.train(jax.jit(learner.init)(jax.random.key(seed)), 1)
        together = jax.tree.map(lambda x, i=i: x[i], (states, metrics))
        close = partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6)
        jax.tree.map(close, *jax.tree.map(raw, (alone, together)))


SLOW = [pytest.param(name, marks=pytest.mark.slow) for name in ("magic", "hetnet")]


@pytest.mark.parametrize("policy", ["ic3net", *SLOW])
def test_seeds_side_by_side_learn_what_they_learn_one_after_the_other(policy):
    learner = tiny_learner(TINY_TASK, policy, num_envs=200, rollout_length=20)
    mesh = parallel.make_mesh(len(SEEDS), 200, devices=1)
    ways = []
    for together, unroll in ((False, 1), (True, 4)):
        states = parallel.place(begun_seeds(learner, SEEDS), mesh)
        way = parallel.Execution(together, unroll)
        ways.append(parallel.make_train(learner, mesh, 1, way)(states))
    close = partial(np.testing.assert_allclose, rtol=1e-3, atol=2e-5)
    jax.tree.map(close, *jax.tree.map(raw, [states.params for states, _ in ways]))
    for name in ("env_steps", "steps_taken", "success", "entropy", "value_loss", "gradient_norm"):
        np.testing.assert_allclose(*(getattr(figures, name) for _, figures in ways), rtol=1e-3)


def test_a_stage_like_an_earlier_one_is_traced_no_second_time():
    """Nor one that goes on after a stop: equal learners have the same functions."""
    first, equal, other = (
        tiny_learner(replace(TINY_TASK, max_steps=n), num_envs=200, rollout_length=20)
        for n in (5, 5, 6)
    )
    mesh, anew = (parallel.make_mesh(1, 200, devices=1) for _ in range(2))
    train = parallel.make_train(first, mesh, 1)
    assert parallel.make_train(equal, anew, 1) is train
    assert parallel.make_train(equal, mesh, 2) is not train
    assert parallel.make_train(other, mesh, 1) is not train
    states = jax.eval_shape(partial(begun_seeds, first, [0]))
    for learner, compiled in ((first, 1), (equal, 0)):
        before = programs_compiled()
        parallel.compile_train(learner, mesh, 1, states)
        assert programs_compiled() - before == compiled


@pytest.mark.skipif(not PIECES.exists(), reason="counts the pieces of memory that Linux lists")
def test_a_process_may_go_through_any_number_of_stages(monkeypatch):
    """The programs of earlier ones are let go before they fill what Linux lets a process map."""

    def pieces_after_stage(max_steps):
        task = replace(TINY_TASK, max_steps=max_steps)
        learner = tiny_learner(task, num_envs=200, rollout_length=20)
        states = jax.eval_shape(partial(begun_seeds, learner, [0]))
        parallel.compile_train(learner, parallel.make_mesh(1, 200, devices=1), 1, states)
        return len(PIECES.read_text().splitlines())

    parallel.make_room(0)
    first, *others = [pieces_after_stage(n) for n in (7, 8, 9)]
    each = others[0] - first
    assert each > 100
    assert others[1] > first + 1.5 * each
    monkeypatch.setattr(parallel, "MOST_PIECES", first + each)
    assert max(pieces_after_stage(n) for n in range(10, 15)) < first + 2.5 * each


def test_seeds_side_by_side_share_every_product():
    """As many products as for one seed, each a batch, and no loop over seeds."""
    learner = tiny_learner(TINY_TASK, "ic3net", num_envs=200, rollout_length=20)
    mesh, found = parallel.make_mesh(3, 200, devices=1), []
    for num_seeds, together in ((1, False), (3, True)):
        states = jax.eval_shape(partial(begun_seeds, learner, list(range(num_seeds))))
        train = parallel.make_train(learner, mesh, 1, parallel.Execution(together))
        program = train.lower(states).as_text()
        products = [line for line in program.splitlines() if "stablehlo.dot_general" in line]
        found.append((program.count("stablehlo.while"), len(products)))
    alone, side_by_side = found
    assert side_by_side == (alone[0] - 1, alone[1])


def test_a_cpu_trains_seeds_one_after_the_other_and_an_accelerator_side_by_side():
    assert not parallel.execution_on("cpu").together
    assert parallel.execution_on("gpu").together
    assert parallel.execution_on("tpu").together


@pytest.fixture(scope="module")
def two_devices():
    script = Path(__file__).with_name("two_devices.py")
    done = subprocess.run(
        [sys.executable, script], capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_seeds_over_two_devices(two_devices):
    assert two_devices["devices"] == 2
    assert two_devices["seeds_mesh"] == {"seeds": 2, "envs": 1}
    assert two_devices["over_seeds"] < 1e-5


def test_a_critic_of_its_own_over_two_devices(two_devices):
    """It learns from the environments of both."""
    assert two_devices["own_critic"] < 1e-4


def test_environments_of_a_seed_over_two_devices(two_devices):
    """Gradients and figures are added up, advantages normalised over all environments."""
    assert two_devices["envs_mesh"] == {"seeds": 1, "envs": 2}
    assert two_devices["over_envs"] < 1e-4
    assert two_devices["between_seeds"] > 1e-2, "the comparison would see a difference"


def test_more_devices_than_there_are():
    with pytest.raises(ValueError, match=r"64 devices asked for, but JAX sees \d+;"):
        parallel.make_mesh(1, 64, devices=64)


def test_environments_that_do_not_spread(monkeypatch):
    monkeypatch.setattr(jax, "device_count", lambda: 4)
    with pytest.raises(ValueError, match="25 environments do not spread over 4 devices"):
        parallel.make_mesh(3, 25, devices=4)


@pytest.mark.parametrize(
    ("num_seeds", "num_envs", "most", "expected"),
    [(1, 50, 8, 5), (3, 50, 8, 6), (3, 50, 2, 2), (1, 49, 6, 1), (7, 49, 14, 7), (2, 4, 64, 8)],
)
def test_the_most_devices_that_seeds_and_environments_spread_over(
    num_seeds, num_envs, most, expected
):
    assert parallel.most_devices(num_seeds, num_envs, most) == expected
    over_seeds, over_envs = parallel.spread(num_seeds, num_envs, expected)
    assert over_seeds * over_envs == expected
    assert num_seeds % over_seeds == num_envs % over_envs == 0


class TestCores:
    """A root directory stands for the files of /proc and /sys."""

    @pytest.fixture(autouse=True)
    def _eight(self, monkeypatch):
        monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
        monkeypatch.setattr(os, "cpu_count", lambda: 64)

    def files(self, root, **content):
        for name, text in content.items():
            file = root / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text)
        return root

    def test_those_of_the_affinity_not_of_the_machine(self, tmp_path):
        assert parallel.usable_cores(tmp_path) == 8

    def test_a_system_without_affinity(self, tmp_path, monkeypatch):
        monkeypatch.delattr(os, "sched_getaffinity")
        assert parallel.usable_cores(tmp_path) == 64

    @pytest.mark.parametrize(
        ("limit", "cores"),
        [("200000 100000", 2), ("250000 100000", 2), ("50000 100000", 1), ("max 100000", 8)],
    )
    @pytest.mark.parametrize("own", ["/", "/pod/box"])
    def test_version_2(self, tmp_path, limit, cores, own):
        files = {"proc/self/cgroup": f"0::{own}\n", f"sys/fs/cgroup{own}/cpu.max": f"{limit}\n"}
        assert parallel.usable_cores(self.files(tmp_path, **files)) == cores

    def test_a_group_has_no_more_than_those_around_it(self, tmp_path):
        files = {
            "proc/self/cgroup": "0::/pod/box\n",
            "sys/fs/cgroup/pod/cpu.max": "300000 100000\n",
            "sys/fs/cgroup/pod/box/cpu.max": "600000 100000\n",
        }
        assert parallel.usable_cores(self.files(tmp_path, **files)) == 3

    @pytest.mark.parametrize(("quota", "cores"), [("400000", 4), ("-1", 8)])
    @pytest.mark.parametrize("inside", ["", "docker/1f"], ids=["topmost", "its own"])
    def test_version_1(self, tmp_path, quota, cores, inside):
        files = {
            "proc/self/cgroup": "4:memory:/docker/1f\n3:cpu,cpuacct:/docker/1f\n",
            f"sys/fs/cgroup/cpu/{inside}/cpu.cfs_quota_us": quota,
            f"sys/fs/cgroup/cpu/{inside}/cpu.cfs_period_us": "100000",
        }
        assert parallel.usable_cores(self.files(tmp_path, **files)) == cores


class TestChoice:
    """Of devices; JAX has been used in these tests, so that it has what it has."""

    @pytest.fixture
    def has(self, monkeypatch):
        def given(count):
            monkeypatch.setattr(jax, "local_devices", lambda: [object()] * count)

        return given

    @pytest.mark.parametrize(
        ("devices", "num_seeds", "num_envs", "expected"),
        [(1, 3, 50, 1), (8, 3, 50, 6), (4, 4, 7, 4)],
    )
    def test_as_many_as_can_share_the_work(self, has, devices, num_seeds, num_envs, expected):
        has(devices)
        assert parallel.choose_devices(num_seeds, num_envs) == expected

    def test_as_many_as_asked_for(self, has):
        has(8)
        assert parallel.choose_devices(3, 50, asked=2) == 2

    def test_more_than_there_are(self, has):
        has(1)
        with pytest.raises(ValueError, match="4 devices asked for, but JAX sees 1;"):
            parallel.choose_devices(1, 100, asked=4)

    def test_a_machine_with_one_gpu_and_many_cores(self, has, monkeypatch):
        """No CPU device is made, and no core counted."""
        has(1)
        monkeypatch.setattr(parallel, "usable_cores", lambda: 64)
        monkeypatch.setattr(parallel, "use_cpu_devices", lambda count: pytest.fail("made some"))
        platforms = jax.config.jax_platforms
        jax.config.update("jax_platforms", "cuda,cpu")
        try:
            assert parallel.choose_devices(1, 64) == 1
        finally:
            jax.config.update("jax_platforms", platforms)


def run_program(program, *arguments, **variables):
    """In a process of its own, whose JAX has not been used."""
    inherited = {k: v for k, v in os.environ.items() if k not in ("XLA_FLAGS", "JAX_PLATFORMS")}
    return subprocess.run(
        [sys.executable, "-c", program, *arguments],
        env={**inherited, **variables},
        capture_output=True,
        text=True,
    )


PROGRAM = """
import os, sys
import jax
from sumajax.learning import parallel
os.sched_getaffinity = lambda _: {0, 1, 2}
if sys.argv[1] == "used":
    jax.devices()
print(parallel.choose_devices(3, 50), jax.local_device_count())
"""


@pytest.mark.parametrize(
    ("state", "variables", "expected"),
    [
        ("fresh", {}, "3 3"),
        ("fresh", {"JAX_PLATFORMS": "cpu"}, "3 3"),
        ("used", {}, "1 1"),
        ("used", {"XLA_FLAGS": "--xla_force_host_platform_device_count=6"}, "6 6"),
    ],
)
def test_cpu_devices_are_made_for_the_cores_unless_jax_has_been_used(state, variables, expected):
    said = run_program(PROGRAM, state, **variables)
    assert said.stdout.split("\n")[0] == expected, said.stderr


@pytest.mark.parametrize("platforms", ["cuda", "nonsense"])
def test_a_platform_that_the_machine_has_not(platforms):
    program = (
        "from sumajax.learning import parallel\n"
        "try: parallel.choose_devices(1, 4)\n"
        "except ValueError as error: print(error)"
    )
    said = run_program(program, JAX_PLATFORMS=platforms)
    assert len(said.stdout.splitlines()) == 1, said.stderr
    assert said.stdout.startswith(
        f"JAX finds no device of the kind that JAX_PLATFORMS='{platforms}'"
    )
    assert "unset JAX_PLATFORMS" in said.stdout
