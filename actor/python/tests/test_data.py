"""Runs and recordings."""

import struct

import numpy as np
import pytest

import skein_rl


@pytest.fixture
def made(policy, tmp_path):
    """A recording like those of skein-evaluate, of two episodes."""
    env = skein_rl.CorridorEnv(courses="training", simulator=policy.simulator)
    columns = {}
    for number in range(2):
        flown = skein_rl.fly(env, policy, number)
        rows = len(flown["reward"])
        flown["episode"] = np.full(rows, number, np.int32)
        flown["course"] = np.zeros(rows, np.int32)
        flown["step"] = np.arange(rows, dtype=np.int32)
        flown["closing"] = (flown["step"] == rows - 1).astype(np.uint8)
        for name, column in flown.items():
            columns.setdefault(name, []).append(column)
    arrays = {name: np.concatenate(parts) for name, parts in columns.items()}
    path = tmp_path / "episodes.npz"
    np.savez_compressed(path, course_names=np.array(["training"]), **arrays)
    return path


def test_a_recording_falls_into_episodes(made):
    recording = skein_rl.read_recording(made)
    episodes = list(recording.episodes())
    assert len(episodes) == 2 and sum(len(one["step"]) for one in episodes) == len(recording)
    for episode in episodes:
        assert episode["step"].tolist() == list(range(len(episode["step"])))
        assert episode["closing"].tolist() == [0] * (len(episode["step"]) - 1) + [1]
        assert (episode["terminated"] | episode["truncated"])[-2] == 1
    assert recording.course_names == ["training"]


def test_a_real_recording_is_read(recording):
    read = skein_rl.read_recording(recording)
    assert len(list(read.episodes())) == 2 * len(read.course_names)
    assert read.reward_term_names == skein_rl.REWARD_TERMS


def test_an_mcap_holds_every_value_of_the_npz(same_episode):
    arrays, mcap = map(skein_rl.read_recording, same_episode)
    for names in ("course_names", "reward_term_names", "action_names"):
        assert getattr(arrays, names) == getattr(mcap, names)
    assert mcap["reconstruction"].shape == mcap["depth"].shape
    assert set(mcap.columns) == {*arrays.columns, "reconstruction"}
    for name, column in arrays.columns.items():
        assert (mcap[name].dtype, mcap[name].shape) == (column.dtype, column.shape), name
        assert mcap[name].tobytes() == column.tobytes(), name
    (scene,), (events,) = mcap.scenes, mcap.events
    assert [name for name in scene if name.startswith("wall")] == [f"wall {n}" for n in range(1, 6)]
    opening = scene["wall 2"].outlines_m[0]
    assert len(scene["wall 2"].triangles_m) > 3 and (opening[0] == opening[-1]).all()
    passed = mcap["walls_passed"].astype(int)
    assert events[0] == (0, "training, episode 0 begins")
    for row, event in events[1:-1]:
        assert event == f"passed wall {passed[row]}" and passed[row - 1] == passed[row] - 1
    assert events[-1] == (len(mcap) - 1, "reached the end")


def test_a_recording_becomes_a_table(made):
    pytest.importorskip("pandas")
    table = skein_rl.read_recording(made).to_pandas()
    terms = [f"reward_{name}" for name in skein_rl.REWARD_TERMS]
    np.testing.assert_allclose(table[terms].sum(axis=1), table["reward"], atol=1e-5)
    assert "position_m_0" in table and "depth" not in table


def test_a_recording_becomes_a_data_set(made, tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    recording = skein_rl.read_recording(made)
    dataset = skein_rl.to_minari(recording, "skein/test-v0", author="test")
    assert dataset.total_episodes == 2
    assert dataset.total_steps == len(recording) - 2
    episode = next(iter(minari.load_dataset("skein/test-v0").iterate_episodes()))
    first = next(recording.episodes())
    np.testing.assert_array_equal(episode.observations["depth"][:, 0], first["depth"])
    np.testing.assert_array_equal(episode.actions, first["action"][:-1])


def test_damaged_recordings_are_named(made, tmp_path):
    sound = made.read_bytes()
    bad = tmp_path / "bad.npz"
    for content in (b"", b"abc", sound[:1000], sound[: len(sound) // 2]):
        bad.write_bytes(content)
        with pytest.raises(ValueError, match="bad.npz"):
            skein_rl.read_recording(bad)
    bad_mcap = tmp_path / "bad.mcap"
    bad_mcap.write_bytes(b"\x89MCAP0\r\n and then nothing")
    with pytest.raises(ValueError, match="bad.mcap"):
        skein_rl.read_recording(bad_mcap)
    np.savez(bad, step=np.zeros(3))
    with pytest.raises(ValueError, match="no array"):
        skein_rl.read_recording(bad)
    with pytest.raises(OSError):
        skein_rl.read_recording(tmp_path / "none.npz")


def event(step, tag, value):
    """A record of a TensorBoard event file, with checksums that nobody reads."""
    content = b"\x0a" + bytes([len(tag)]) + tag.encode() + b"\x15" + struct.pack("<f", value)
    summary = b"\x0a" + bytes([len(content)]) + content
    body = b"\x09" + struct.pack("<d", 1e9) + b"\x10" + bytes([step])
    body += b"\x2a" + bytes([len(summary)]) + summary
    return struct.pack("<QI", len(body), 0) + body + bytes(4)


@pytest.fixture
def run(tmp_path, generalist):
    root = tmp_path / "run"
    (root / "tensorboard").mkdir(parents=True)
    (root / "snapshots").mkdir()
    (root / "snapshots" / "best.safetensors").write_bytes(generalist.read_bytes())
    (root / "config.toml").write_text('[run]\nseed = 3\n[learning]\nobservation = "latent"\n')
    (root / "summary.json").write_text('{"steps": 12, "seed": 3}')
    (root / "evaluation.json").write_text(
        '{"policy_sha256": "%s", "courses": [{"course": "training", "episodes": 10,'
        ' "completed": 0.9, "mean_return": 5.5}]}' % skein_rl.Policy.load(generalist).sha256
    )
    (root / "episodes.csv").write_text("episode,return,outcome\n0,1.5,collided\n1,2,reached_end\n2,")
    events = event(1, "loss", 0.5) + event(2, "loss", 0.25) + event(2, "walls", 3.0)
    (root / "tensorboard" / "events.out.tfevents.1").write_bytes(events + events[:20])
    return root


def test_a_run_is_read(run):
    read = skein_rl.read_run(run)
    assert read.config["run"]["seed"] == 3 and read.summary["steps"] == 12
    assert read.episodes["return"].tolist() == [1.5, 2.0]
    assert read.episodes["outcome"].tolist() == ["collided", "reached_end"]
    assert read.curves["loss"]["value"].tolist() == [0.5, 0.25]
    assert read.curves["loss"]["step"].tolist() == [1, 2]
    assert [path.name for path in read.snapshots] == ["best.safetensors"]
    (run / "summary.json").write_text("{")
    with pytest.raises(ValueError, match="summary.json"):
        skein_rl.read_run(run)
    (run / "config.toml").write_text("[")
    with pytest.raises(ValueError, match="config.toml"):
        skein_rl.read_run(run)
    with pytest.raises(FileNotFoundError, match="config.toml"):
        skein_rl.read_run(run / "snapshots")


def test_a_runs_curves_become_a_table(run):
    pytest.importorskip("pandas")
    table = skein_rl.read_run(run).curves_to_pandas()
    assert sorted(table["curve"]) == ["loss", "loss", "walls"]


def test_a_model_card_says_what_how_and_how_well(run):
    path = skein_rl.export.write_model_card(run / "snapshots" / "best.safetensors", run)
    card = path.read_text()
    for part in ("library_name: skein-rl", "| training | 10 | 90.0 % | 5.50 |", "## Limits"):
        assert part in card
    code = card.split("```python\n")[1].split("```")[0]
    import contextlib, io, os

    with contextlib.chdir(path.parent) if hasattr(contextlib, "chdir") else contextlib.nullcontext():
        printed = io.StringIO()
        with contextlib.redirect_stdout(printed):
            if os.path.exists("best.safetensors"):
                exec(code, {})
    assert printed.getvalue()


def test_a_run_goes_to_wandb_offline(run, tmp_path, monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_SILENT", "true")
    folder = skein_rl.export.wandb(run, dir=str(tmp_path))
    assert "offline-run" in folder


def test_a_run_goes_to_mlflow(run, tmp_path):
    mlflow = pytest.importorskip("mlflow")
    mlflow.set_tracking_uri(f"sqlite:///{tmp_path}/mlflow.db")
    number = skein_rl.export.mlflow(run)
    history = mlflow.tracking.MlflowClient().get_metric_history(number, "loss")
    assert [point.value for point in history] == [0.5, 0.25]


def test_a_run_goes_to_trackio(run, tmp_path, monkeypatch):
    monkeypatch.setenv("TRACKIO_DIR", str(tmp_path))
    pytest.importorskip("trackio")
    skein_rl.export.trackio(run)
    assert any(tmp_path.rglob("*.db"))
