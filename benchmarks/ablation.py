"""What each part of `best` adds, and what was tried and left out: on validation cuts.

python -m benchmarks.ablation [--only TEXT] [--json FILE] [--first-parts]

A network is trained without two scenes and scored on the validation cuts of these two, whose places it has never seen:
three networks a variant, all five scenes, one seed. About six minutes a variant on one core. For each fold the cuts of
the other scenes are training scenes' own; but as one recipe serves all folds, the last part of every scene has had a
say in it. `--first-parts` scores the networks that ship on what is left of their test scenes.
"""

import argparse
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from pcgan import checkpoint
from pcgan.clips import load_clip
from pcgan.dataset import Windows, clip_windows, concatenate
from pcgan.evaluation import append_lines, as_line
from pcgan.forecast import Extrapolation
from pcgan.learners import LossWeights
from pcgan.methods import load_method
from pcgan.model import ModelConfig
from pcgan.protocols import ETH_UCY_SCENES, ETH_UCY_SPEC, between, first_validation_step
from pcgan.recipes import Recipe, recipe_for
from pcgan.scores import measure, quick_scores
from pcgan.train import TrainConfig, train
from pcgan.training_data import training_data

PAIRS = (("eth", "hotel"), ("univ", "zara1"), ("zara2", "eth"))
FIGURES = ("ade", "fde", "mhd", "nll", "min_ade", "min_ade_20", "collision_rate", "coverage_90", "modal_paths")


def with_network(**changes: object) -> Callable[[Recipe], Recipe]:
    """Returns a change of the network's configuration."""

    def change(recipe: Recipe) -> Recipe:
        assert isinstance(recipe.network, ModelConfig)
        return replace(recipe, network=replace(recipe.network, **changes))  # type: ignore[arg-type]

    return change


VARIANTS: dict[str, Callable[[Recipe], Recipe]] = {
    "best": lambda recipe: recipe,
    "social pooling": with_network(pooling="social"),
    "no pooling": with_network(pooling="none"),
    "adversarial 0.2": lambda recipe: replace(recipe, loss=LossWeights(adversarial=0.2, adversarial_from=5)),
    "adversarial 1": lambda recipe: replace(recipe, loss=LossWeights(adversarial=1.0, adversarial_from=5)),
    "likelihood alone": lambda recipe: replace(recipe, loss=LossWeights(path=0.0)),
    "no noise": lambda recipe: replace(recipe, augmentation=replace(recipe.augmentation, noise_m=0.0)),
    "no reversed windows": lambda recipe: replace(recipe, reversed_share=0.0),
    "20 epochs, batches of 256": lambda recipe: replace(recipe, epochs=20, batch_pedestrians=256),
}


def main() -> None:
    """Trains and scores the variants, and prints a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", default="", help="only variants whose name has this in it")
    parser.add_argument("--epochs", type=int, help="instead of the recipe's, for a quick look")
    parser.add_argument("--json", type=Path, help="write the figures to this file as well")
    parser.add_argument(
        "--first-parts", action="store_true", help="instead: the networks that ship, on test scenes without these cuts"
    )
    arguments = parser.parse_args()
    if arguments.first_parts:
        first_parts()
        return
    table = Table("variant", *FIGURES, title="mean of five scenes, 12 steps, validation cuts")
    found = {}
    for name, change in VARIANTS.items():
        if arguments.only not in name:
            continue
        recipe = change(recipe_for("pcgan"))
        recipe = recipe if arguments.epochs is None else replace(recipe, epochs=arguments.epochs)
        found[name] = figures(recipe)
        table.add_row(name, *(f"{found[name][figure]:.4f}" for figure in FIGURES))
    Console(width=150).print(table)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(found, indent=1) + "\n")


def figures(recipe: Recipe, seed: int = 0) -> dict[str, float]:
    """Returns a recipe's figures, the mean over scenes."""
    scenes: dict[str, list[dict[str, float]]] = {}
    for pair in PAIRS:
        data = training_data("eth_ucy", recipe, leave_out=",".join(pair), seed=seed)
        with TemporaryDirectory() as folder:
            method = load_method(train(TrainConfig(recipe, Path(folder), seed=seed), data))
        for scene in pair:
            scores = measure(method, validation_cut(scene), (12,), torch.Generator().manual_seed(0)).scores(12)
            scenes.setdefault(scene, []).append(scores.as_dict())
    return {
        name: float(np.mean([np.mean([score[name] for score in scores]) for scores in scenes.values()]))
        for name in FIGURES
    }


def first_parts() -> None:
    """Prints how shipped folds do on the parts of their test scenes that no variant was compared on."""
    table = Table(
        "scene", "PCGAN ADE", "FDE", "weighted velocity ADE", "FDE", title="test scenes' first parts, 12 steps"
    )
    rows, looks = [], []
    for scene, files in ETH_UCY_SCENES.items():
        cut = [between(load_clip(f"eth_ucy/{file}"), 0, first_validation_step(file)) for file in files]
        windows = concatenate([clip_windows(clip, ETH_UCY_SPEC) for clip in cut])
        path = checkpoint.TABLE_WEIGHTS / f"pcgan_eth_ucy_{scene}.safetensors"
        ours = quick_scores(load_method(path), windows)
        straight = quick_scores(Extrapolation("weighted", ETH_UCY_SPEC.predicted_steps, ETH_UCY_SPEC.dt_s), windows)
        looks.append(as_line("pcgan", path, f"{scene} first part@12", ours, "benchmarks.ablation --first-parts"))
        rows.append((ours.ade, ours.fde, straight.ade, straight.fde))
        table.add_row(scene, *(f"{value:.3f}" for value in rows[-1]))
    table.add_row("mean", *(f"{value:.3f}" for value in np.mean(rows, axis=0)))
    Console(width=120).print(table)
    append_lines(looks)


def validation_cut(scene: str) -> Windows:
    """Returns the windows of a scene's validation part."""
    parts = [
        clip_windows(between(load_clip(f"eth_ucy/{file}"), first_validation_step(file), np.inf), ETH_UCY_SPEC)
        for file in ETH_UCY_SCENES[scene]
    ]
    return concatenate(parts)


if __name__ == "__main__":
    main()
