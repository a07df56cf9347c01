"""What others show of Skein's files: TensorBoard, Rerun."""

import os
import subprocess

import numpy as np
import pytest
from conftest import REPOSITORY

import skein_rl


@pytest.fixture(scope="session")
def run(tmp_path_factory):
    """A short run, if launch/python.sh found the programs."""
    program = os.environ.get("SKEIN")
    if not program:
        pytest.skip("SKEIN names no program: launch/python.sh sets it once the learner is built")
    path = tmp_path_factory.mktemp("run") / "run"
    command = [*program.split(), "run", "--config", REPOSITORY / "tests/small.toml", "--run-dir", path, "--actors", "1"]
    subprocess.run(command, check=True, capture_output=True, timeout=600)
    return path


def loaded(folder):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder), size_guidance={"scalars": 0, "images": 0, "tensors": 0})
    events.Reload()
    return events


def test_tensorboard_reads_curves_pictures_and_text(run):
    pytest.importorskip("tensorboard")
    events = loaded(run / "tensorboard")
    scalars = events.Tags()["scalars"]
    episodes = skein_rl.read_run(run).episodes
    rate = [event.value for event in events.Scalars("window/success_rate")]
    reached = np.array(episodes["outcome"] == "reached_end", float)
    expected = [reached[max(0, end - 20) : end].mean() for end in range(1, len(reached) + 1)]
    np.testing.assert_allclose(rate, expected, atol=1e-6)
    for tag in (
        "policy/smallest_value",
        "policy/largest_value",
        "gradient_norm/critic",
        "gradient_norm/policy",
        "learning_rate/policy",
        "learning_rate/vae",
        "evaluation/training/completed",
        "evaluation/non-rectangular/return",
    ):
        assert tag in scalars, tag
    assert not [tag for tag in scalars if tag.startswith(("refused/", "reissued/"))], "the run was calm"
    values = [[event.value for event in events.Scalars(f"policy/{name}_value")] for name in ("smallest", "mean", "largest")]
    assert all(low <= middle <= high for low, middle, high in zip(*values))
    picture = events.Images("vae/depth_above_reconstruction")[-1]
    assert (picture.width, picture.height) == (8 * 132 - 4, 148) and picture.encoded_image_string.startswith(b"\x89PNG")
    (text,) = events.Tensors("configuration")[-1].tensor_proto.string_val
    assert b"[run]" in text and b"episodes = 40" in text

    over_steps = loaded(run / "tensorboard" / "over_steps")
    last = over_steps.Scalars("window/return")[-1]
    assert last.step == int(np.sum(episodes["steps"]))
    assert last.value == events.Scalars("window/return")[-1].value


def test_tensorboard_reads_the_settings_that_differ_from_the_defaults(run):
    pytest.importorskip("tensorboard")
    from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData

    contents = loaded(run / "tensorboard").PluginTagToContent("hparams")
    session = HParamsPluginData.FromString(contents["_hparams_/session_start_info"]).session_start_info
    assert session.hparams["run.episodes"].number_value == 40
    assert session.hparams["sac.hidden_width"].number_value == 32
    assert session.hparams["simulator.vehicle.preset"].string_value == "point"
    assert "sac.discount" not in session.hparams
    experiment = HParamsPluginData.FromString(contents["_hparams_/experiment"]).experiment
    assert {info.name for info in experiment.hparam_infos} == set(session.hparams)
    assert "window/success_rate" in {info.name.tag for info in experiment.metric_infos}


def rerun(*arguments):
    """What the program of rerun-sdk prints; it fails where that fails."""
    done = subprocess.run(["rerun", *arguments], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


def test_rerun_takes_a_recording_with_all_that_it_holds(same_episode, tmp_path):
    pytest.importorskip("rerun")
    import skein_rl.rerun

    everywhere = ["world/drone/camera/depth", "velocity/forward", "reward/level_up", "oracle_action/left", "events"]
    for path, more in zip(same_episode, ([], ["world/course/wall_1/surface", "reconstruction"])):
        flights = tmp_path / f"{path.suffix[1:]}.rrd"
        skein_rl.rerun.save(skein_rl.read_recording(path), flights)
        rerun("rrd", "verify", flights)
        stored = rerun("rrd", "print", "-v", flights)
        for entity in [*everywhere, *more]:
            assert f"/{entity}" in stored, entity


def test_rerun_takes_an_mcap_as_it_is(same_episode, tmp_path):
    pytest.importorskip("rerun")
    _, mcap = same_episode
    rerun("mcap", "check", mcap)
    converted = tmp_path / "converted.rrd"
    rerun("mcap", "convert", mcap, "--output", converted)
    rerun("rrd", "verify", converted)
