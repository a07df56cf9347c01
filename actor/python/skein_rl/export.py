"""A run's curves, configuration and snapshot for other tools, through their own packages."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from .data import Run, read_run
from .policy import Policy

__all__ = ["mlflow", "model_card", "trackio", "wandb", "write_model_card"]


def wandb(run: Run | str | os.PathLike[str], *, project: str = "skein", **keywords: Any) -> str:
    """Writes a run into W&B, offline unless ``mode="online"`` is given.

    Args:
        run: a run or its directory.
        project: W&B's project.
        **keywords: for ``wandb.init``.

    Returns:
        W&B's directory of the run: ``wandb sync DIRECTORY`` uploads it.
    """
    run = _opened(run)
    try:
        import wandb as package
    except ImportError:
        raise ImportError('export.wandb needs W&B: pip install "skein-rl[wandb]"') from None
    keywords.setdefault("mode", "offline")
    keywords.setdefault("name", run.path.name)
    started = package.init(project=project, config=run.config, **keywords)
    try:
        for step, values in _by_step(run):
            started.log(values, step=step)
        started.summary.update(_flat(run.summary))
        best = _best(run)
        if best is not None:
            artifact = package.Artifact(f"{run.path.name}-policy", type="model")
            artifact.add_file(str(best))
            started.log_artifact(artifact)
        return str(Path(started.dir).parent)
    finally:
        started.finish()


def mlflow(run: Run | str | os.PathLike[str], *, experiment: str = "skein", **keywords: Any) -> str:
    """Writes a run into MLflow's present tracking store.

    Args:
        run: a run or its directory.
        experiment: MLflow's experiment.
        **keywords: for ``mlflow.start_run``.

    Returns:
        MLflow's id of the run.
    """
    run = _opened(run)
    try:
        import mlflow as package
        from mlflow.entities import Metric
        from mlflow.tracking import MlflowClient
    except ImportError:
        raise ImportError('export.mlflow needs MLflow: pip install "skein-rl[mlflow]"') from None
    package.set_experiment(experiment)
    keywords.setdefault("run_name", run.path.name)
    with package.start_run(**keywords) as started:
        parameters = [(key, str(value)[:500]) for key, value in _flat(run.config).items()]
        for first in range(0, len(parameters), 100):
            package.log_params(dict(parameters[first : first + 100]))
        metrics = [
            Metric(name, float(value), int(time * 1000), int(step))
            for name, curve in run.curves.items()
            for step, time, value in zip(curve["step"], curve["wall_time"], curve["value"])
        ]
        client = MlflowClient()
        for first in range(0, len(metrics), 1000):
            client.log_batch(started.info.run_id, metrics=metrics[first : first + 1000])
        for file in (run.path / "config.toml", run.path / "evaluation.json", _best(run)):
            if file is not None and file.is_file():
                package.log_artifact(str(file))
        return str(started.info.run_id)


def trackio(run: Run | str | os.PathLike[str], *, project: str = "skein", **keywords: Any) -> None:
    """Writes a run into Trackio's local store.

    Args:
        run: a run or its directory.
        project: Trackio's project.
        **keywords: for ``trackio.init``.
    """
    run = _opened(run)
    try:
        import trackio as package
    except ImportError:
        raise ImportError('export.trackio needs Trackio: pip install "skein-rl[trackio]"') from None
    keywords.setdefault("name", run.path.name)
    package.init(project=project, config=_flat(run.config), **keywords)
    try:
        for step, values in _by_step(run):
            package.log(values, step=step)
    finally:
        package.finish()


def model_card(
    snapshot: str | os.PathLike[str], run: Run | str | os.PathLike[str] | None = None
) -> str:
    """Describes a snapshot in Markdown: what it is, how it was trained, its results, its limits.

    Args:
        snapshot: the snapshot's file.
        run: the run that it comes from; its evaluation gives the results.
    """
    policy = Policy.load(snapshot, threads=1)
    run = None if run is None else _opened(run)
    name = Path(snapshot).name
    parts = [
        _front_matter(),
        f"# {Path(snapshot).stem}: a quadrotor that avoids obstacles by its depth camera",
        _what(policy),
        f"## How to use\n\n{_use(name)}",
        f"## Results\n\n{_results(policy, run)}",
        f"## Training\n\n{_training(policy, run)}",
        f"## Limits\n\n{_LIMITS}",
    ]
    return "\n\n".join(parts) + "\n"


def write_model_card(
    snapshot: str | os.PathLike[str], run: Run | str | os.PathLike[str] | None = None
) -> Path:
    """Writes :func:`model_card` beside the snapshot, ``NAME.md``, and returns its path."""
    path = Path(snapshot).with_suffix(".md")
    path.write_text(model_card(snapshot, run), encoding="utf-8")
    return path


_LIMITS = """\
- It was trained and evaluated in simulation alone. Nobody has flown it on a real drone.
- It flies forward at the trained speed and steers left, right, up and down. It does not stop.
- It knows corridors with walls that have one opening each. Other scenes are untried.
- It expects the trained camera: planar depth, 128 x 72 pixels, 90 degrees wide."""


def _front_matter() -> str:
    return (
        "---\nlibrary_name: skein-rl\ntags:\n- reinforcement-learning\n- robotics\n"
        "- Skein/Corridor-v0\n---"
    )


def _what(policy: Policy) -> str:
    learning = policy.config.get("learning", {})
    algorithm, encoder = learning.get("algorithm", "sac"), learning.get("encoder", "vae")
    history = policy.history_steps
    seen = "the present step"
    if history:
        seen += f" and those {', '.join(map(str, history))} steps ago"
    return (
        f"A policy of Skein, trained by `{algorithm}` on codes of "
        f"{policy.latent} numbers (`{encoder}`). It sees `{policy.observation}` of {seen}, and "
        f"returns the velocity to command left and up, m/s.\n\n"
        f"- policy version: {policy.version}\n- SHA-256 of the parameters: `{policy.sha256}`"
    )


def _use(name: str) -> str:
    return (
        "```python\nimport skein_rl\n\n"
        f'policy = skein_rl.Policy.load("{name}")\n'
        'env = skein_rl.CorridorEnv(courses="random", simulator=policy.simulator)\n'
        "observation, info = env.reset(seed=1)\npolicy.reset()\nended = False\n"
        "while not ended:\n"
        "    action = policy.act(observation)\n"
        "    observation, reward, terminated, truncated, info = env.step(action)\n"
        "    ended = terminated or truncated\n"
        'print(skein_rl.OUTCOMES[info["outcome"]], info["walls_passed"])\n```'
    )


def _results(policy: Policy, run: Run | None) -> str:
    if run is None or not run.evaluation:
        return "No evaluation lies beside this snapshot: `launch/evaluate.sh` makes one."
    if run.evaluation.get("policy_sha256") != policy.sha256:
        return "The run's evaluation is of another snapshot."
    rows = [
        f"| {course['course']} | {course['episodes']} | {100 * course['completed']:.1f} % "
        f"| {course['mean_return']:.2f} |"
        for course in run.evaluation["courses"]
    ]
    return "\n".join(
        ["| course | episodes | completed | mean return |", "|---|---|---|---|", *rows]
    )


def _training(policy: Policy, run: Run | None) -> str:
    lines = []
    if run is not None and run.summary:
        keys = ("seed", "episodes", "steps", "updates", "skein_version")
        lines = [f"- {key}: {run.summary[key]}" for key in keys if key in run.summary]
    settings = _flat(policy.config)
    table = [f"| `{key}` | `{value}` |" for key, value in settings.items()]
    return "\n".join([*lines, "", "| setting | value |", "|---|---|", *table]).strip()


def _opened(run: Run | str | os.PathLike[str]) -> Run:
    return run if isinstance(run, Run) else read_run(run)


def _best(run: Run) -> Path | None:
    best = run.path / "snapshots" / "best.safetensors"
    return best if best.is_file() else None


def _by_step(run: Run) -> list[tuple[int, dict[str, float]]]:
    """All curves' values by step, steps rising."""
    by_step: dict[int, dict[str, float]] = {}
    for name, curve in run.curves.items():
        for step, value in zip(curve["step"], curve["value"]):
            by_step.setdefault(int(step), {})[name] = float(value)
    return sorted(by_step.items())


def _flat(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in settings.items():
        if isinstance(value, Mapping):
            flat.update(_flat(value, f"{prefix}{key}."))
        else:
            flat[f"{prefix}{key}"] = value
    return flat
