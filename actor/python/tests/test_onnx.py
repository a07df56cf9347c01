"""The ONNX graph, beside the actor's arithmetic."""

import os
import subprocess

import numpy as np
import pytest
from conftest import CONFIGS, snapshot_file

import skein_rl

onnx = pytest.importorskip("onnx")
runtime = pytest.importorskip("onnxruntime")

ACTIONS = {"lateral": 2, "velocity": 3, "velocity+yaw": 4}
CASES = [
    (algorithm, observation, history, latent, "lateral")
    for algorithm in ("sac", "td3", "distill")
    for observation in ("latent", "latent+velocity", "latent+velocity+action")
    for history, latent in (([], 32), ([1], 8), ([2, 4], 64))
] + [
    ("sac", "latent+velocity+action+goal", [2, 4], 8, "velocity+yaw"),
    ("sac", "latent+velocity+action", [1], 8, "velocity"),
    ("td3", "latent+velocity+goal", [], 8, "velocity"),
    ("distill", "latent+goal", [1], 8, "lateral"),
]


def length_of(observation, action):
    """Numbers of a step behind the latent code."""
    velocity = 2 if action == "lateral" else 3
    lengths = {"velocity": velocity, "action": ACTIONS[action], "goal": 4}
    return sum(lengths[part] for part in observation.split("+")[1:])


def session_of(path):
    onnx.checker.check_model(str(path), full_check=True)
    options = runtime.SessionOptions()
    options.intra_op_num_threads = 1
    return runtime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def history_of(session, rows):
    shape = next(one.shape for one in session.get_inputs() if one.name == "history")
    return np.zeros((rows, *shape[1:]), np.float32)


def largest_difference(policy, session, steps, action="lateral"):
    """Flies two episodes at once by the policy; compares each action with the graph's."""
    vector = skein_rl.make_vec(
        2,
        1,
        courses="random",
        vehicle={"action": action},
        observation=["depth", "velocity", "goal", "previous_action"],
        autoreset_mode="DISABLED",
    )
    given = [one.name for one in session.get_inputs() if one.name != "history"]
    observations, _ = vector.reset(seed=3)
    history, largest = history_of(session, 2), 0.0
    policy.reset(2)
    for _ in range(steps):
        actions = policy.act(observations)
        inputs = {name: observations[name] for name in given}
        found, history = session.run(None, {**inputs, "history": history})
        largest = max(largest, float(np.abs(found - actions).max()))
        observations, _, terminated, truncated, _ = vector.step(actions)
        if (terminated | truncated).any():
            observations, _ = vector.reset(seed=4)
            policy.reset(2)
            history = history_of(session, 2)
    return largest


@pytest.mark.parametrize(("algorithm", "observation", "history", "latent", "action"), CASES)
def test_every_kind_of_policy_agrees(tmp_path, algorithm, observation, history, latent, action):
    sections = [
        f'[learning]\nalgorithm = "{algorithm}"\nobservation = "{observation}"\n'
        f"history_steps = {history}",
        f"[vae]\nlatent = {latent}\n[{algorithm}]\nhidden_width = 16",
        f'[simulator.vehicle]\naction = "{action}"',
    ]
    if algorithm == "distill":
        sections.append('[teacher]\npolicy = "oracle"')
    snapshot = snapshot_file(
        tmp_path / "policy.safetensors",
        "\n".join(sections),
        latent,
        latent + length_of(observation, action),
        history,
        ACTIONS[action] * (1 if algorithm == "td3" else 2),
    )
    policy = skein_rl.Policy.load(snapshot, threads=1)
    policy.to_onnx(tmp_path / "graph.onnx")
    assert largest_difference(policy, session_of(tmp_path / "graph.onnx"), 20, action) < 1e-5


def test_the_shipped_policy_agrees_on_whole_episodes(policy, tmp_path):
    policy.to_onnx(tmp_path / "graph.onnx")
    session = session_of(tmp_path / "graph.onnx")
    # Both round to float32; where the policy is steep, that shows.
    assert largest_difference(policy, session, 150) < 5e-5


def differences_by_course(session, recording):
    """Differences of the graph's actions from recorded ones, a number a step."""
    recorded = skein_rl.read_recording(recording)
    differences = {}
    for episode in recorded.episodes():
        history = history_of(session, 1)
        course = recorded.course_names[episode["course"][0]]
        for step, expected in enumerate(episode["action"][:-1]):
            inputs = {
                "depth": episode["depth"][step][None, None],
                "velocity": episode["velocity_mps"][step][None],
                "history": history,
            }
            action, history = session.run(None, inputs)
            differences.setdefault(course, []).append(np.abs(action[0] - expected).max())
    return differences


def test_it_agrees_with_a_recorded_episode(policy, recording, tmp_path):
    policy.to_onnx(tmp_path / "graph.onnx")
    differences = differences_by_course(session_of(tmp_path / "graph.onnx"), recording)
    assert max(differences["training"]) < 1e-5
    for of_course in differences.values():
        assert np.quantile(of_course, 0.95) < 1e-5 and max(of_course) < 5e-5


def test_the_snapshot_of_a_run_agrees_with_its_recorded_episodes(tmp_path):
    """A run of smoke.toml, shortened, by the real programs; its evaluation, recorded."""
    program = os.environ.get("SKEIN")
    if not program:
        pytest.skip("SKEIN names no program: launch/python.sh sets it once skein is built")
    run, recording = tmp_path / "run", tmp_path / "episodes.npz"
    snapshot = run / "snapshots" / "latest.safetensors"
    for command in (
        ["run", "--config", CONFIGS / "smoke.toml", "--run-dir", run, "--set", "run.episodes=60"],
        ["evaluate", "--snapshot", snapshot, "--episodes", "2", "--record", recording],
    ):
        done = subprocess.run([program, *command], capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
    policy = skein_rl.Policy.load(snapshot, threads=1)
    policy.to_onnx(tmp_path / "graph.onnx")
    differences = differences_by_course(session_of(tmp_path / "graph.onnx"), recording)
    assert sum(map(len, differences.values())) > 20
    for of_course in differences.values():
        assert max(of_course) < 1e-5


def test_the_graph_says_what_it_is(policy, tmp_path):
    model = onnx.load_from_string(policy.to_onnx())
    assert [(entry.domain, entry.version) for entry in model.opset_import] == [("", 17)]
    about = {entry.key: entry.value for entry in model.metadata_props}
    assert about["skein.policy_sha256"] == policy.sha256
    assert "[learning]" in about["skein.config"]
    names = [one.name for one in (*model.graph.input, *model.graph.output)]
    assert names == ["depth", "velocity", "history", "action", "next_history"]
    assert all(one.doc_string for one in (*model.graph.input, *model.graph.output))
