"""From a method and windows to the figures of the tables: every pedestrian is measured once, then averaged as asked.

`measure` asks the method for each scene once and keeps the figures of every pedestrian. From them come the scores at
each horizon (a forecast of 12 steps, cut to 8), of any subset (near a vehicle), and the curves of the report.

Who is scored: pedestrians seen at every observed step, whose future is known at every step up to the horizon. Others
in the scene are neighbours only. What is scored: the most probable path; of methods with samples, the mean of the
errors of the first 10, as the paper has it for SGAN.
"""

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from pcgan import distribution_metrics, metrics
from pcgan.batches import Batch, batches
from pcgan.dataset import Windows
from pcgan.forecast import Forecast, Method
from pcgan.mixture_density import GaussianMixture, log_likelihood
from schemas.messages import BoolArray, FloatArray, IntArray

AVERAGED_SAMPLES = 10
BEST_OF = 20
KDE_SAMPLES = 200  # papers take 2000, which gives up to 0.07 nats less
DENSITY_SAMPLES = 64
SHARES = np.arange(1, 20) / 20  # the regions of a reliability curve: 5 % to 95 %
_CHUNK = 128  # pedestrians whose draws fit a processor's cache


@dataclass(frozen=True)
class Scores:
    """Means over pedestrians at one horizon. Distances in m, likelihoods in nats per step (densities per m^2)."""

    pedestrians: int
    ade: float
    fde: float
    mhd: float
    nll: float  # of the mixture
    kde_nll: float  # of a kernel estimate from samples, the only one that sample-based papers can give
    min_ade: float  # of the modal path nearest to the truth
    min_fde: float  # likewise; not always the same path
    min_ade_20: float  # of the nearest of 20 samples
    min_fde_20: float
    miss_rate: float  # share whose last step is more than 2 m off
    collision_rate: float  # share who come nearer than 0.2 m to somebody at a step
    true_collision_rate: float  # the same of what people really did
    coverage_50: float  # share of the steps within the region that should hold 50 %
    coverage_90: float
    coverage_95: float
    area_90_m2: float  # of the 90 % region: sharpness
    modal_paths: float  # per pedestrian

    def as_dict(self) -> dict[str, float]:
        """Returns the figures by name."""
        return asdict(self)


@dataclass(frozen=True, eq=False)
class Curves:
    """What the report plots of one method."""

    times_s: FloatArray  # (P,)
    error_m: FloatArray  # (P,) mean distance from the truth
    nll: FloatArray  # (P,) nats
    shares: FloatArray  # (Q,) of probability that highest-density regions should hold
    coverage: FloatArray  # (Q,) share of the truths that they hold


@dataclass(frozen=True, eq=False)
class StepFigures:
    """Figures of B pedestrians at P steps; without meaning where the future is not known."""

    error_m: FloatArray  # (B, P)
    missed: FloatArray  # (B, P) share of the answers more than 2 m off
    collided: FloatArray  # (B, P) share of the answers that have collided by then
    truly_collided: FloatArray  # (B, P) 1 for those who really came that near by then
    nll: FloatArray  # (B, P)
    kde_nll: FloatArray  # (B, P)
    rank: FloatArray  # (B, P) 0 to 1, see distribution_metrics.density_ranks
    area_90_m2: FloatArray  # (B, P)


@dataclass(frozen=True, eq=False)
class PathFigures:
    """Figures of B pedestrians' paths up to one horizon."""

    mhd: FloatArray  # (B,)
    min_ade: FloatArray  # (B,)
    min_fde: FloatArray  # (B,)
    min_ade_20: FloatArray  # (B,)
    min_fde_20: FloatArray  # (B,)


Figures = TypeVar("Figures", StepFigures, PathFigures)


@dataclass(frozen=True, eq=False)
class Measured:
    """One method's figures of every pedestrian who is scored at the shortest horizon."""

    dt_s: float
    rows: IntArray  # (B,) of the windows
    reach: IntArray  # (B,) up to which step the future is known
    modal_paths: IntArray  # (B,)
    steps: StepFigures
    paths: dict[int, PathFigures]  # by horizon

    def scores(self, horizon: int, among: BoolArray | None = None) -> Scores:
        """Returns the means at a horizon over all, or over the windows' rows where `among` (N,) is true.

        Raises ValueError if that is nobody, or if the horizon was not measured.
        """
        if horizon not in self.paths:
            raise ValueError(f"measured at the horizons {sorted(self.paths)}, not {horizon}")
        scored = self._scored(horizon, among)
        steps, paths = self.steps, self.paths[horizon]
        upto = (scored, slice(0, horizon))
        last = (scored, horizon - 1)
        held = distribution_metrics.coverage(
            torch.from_numpy(steps.rank[upto]).flatten(), torch.tensor([0.5, 0.9, 0.95])
        ).tolist()
        return Scores(
            pedestrians=int(scored.sum()),
            ade=float(steps.error_m[upto].mean()),
            fde=float(steps.error_m[last].mean()),
            mhd=float(paths.mhd[scored].mean()),
            nll=float(steps.nll[upto].mean()),
            kde_nll=float(steps.kde_nll[upto].mean()),
            min_ade=float(paths.min_ade[scored].mean()),
            min_fde=float(paths.min_fde[scored].mean()),
            min_ade_20=float(paths.min_ade_20[scored].mean()),
            min_fde_20=float(paths.min_fde_20[scored].mean()),
            miss_rate=float(steps.missed[last].mean()),
            collision_rate=float(steps.collided[last].mean()),
            true_collision_rate=float(steps.truly_collided[last].mean()),
            coverage_50=held[0],
            coverage_90=held[1],
            coverage_95=held[2],
            area_90_m2=float(steps.area_90_m2[upto].mean()),
            modal_paths=float(self.modal_paths[scored].mean()),
        )

    def figures(self, among: BoolArray | None = None) -> dict[str, dict[str, float]]:
        """Returns the scores as `pcgan.tables` wants them: horizon in steps, as a string -> figure by name."""
        return {str(horizon): self.scores(horizon, among).as_dict() for horizon in sorted(self.paths)}

    def curves(self, among: BoolArray | None = None) -> Curves:
        """Returns error and likelihood against time and the reliability, over those scored at the longest horizon."""
        P = max(self.paths)
        scored = self._scored(P, among)
        ranks = torch.from_numpy(self.steps.rank[scored, :P]).flatten()
        return Curves(
            times_s=self.dt_s * np.arange(1, P + 1),
            error_m=self.steps.error_m[scored, :P].mean(axis=0),
            nll=self.steps.nll[scored, :P].mean(axis=0),
            shares=SHARES,
            coverage=distribution_metrics.coverage(ranks, torch.from_numpy(SHARES)).numpy(),
        )

    def _scored(self, horizon: int, among: BoolArray | None) -> BoolArray:
        scored = self.reach >= horizon
        if among is not None:
            scored = scored & among[self.rows]
        if not scored.any():
            raise ValueError(f"nobody has a complete history and a future known for {horizon} steps")
        return np.asarray(scored)


@dataclass(frozen=True)
class QuickScores:
    """What a training run watches: means over the pedestrians chosen, in m and nats per step."""

    pedestrians: int
    ade: float
    fde: float
    mhd: float
    nll: float
    modal_paths: float


def scorable(windows: Windows, horizon: int) -> BoolArray:
    """(N,) who is scored: seen at every observed step, future known at every step up to the horizon."""
    return np.asarray(windows.complete & windows.known[:, :horizon].all(axis=1))


def near_vehicle(windows: Windows, distance_m: float = 5.0) -> BoolArray:
    """(N,) who comes this near to a vehicle at any observed step; the windows do not hold its future."""
    apart = np.linalg.norm(windows.vehicle[:, :, :2] - windows.observed, axis=-1)  # (N, T) NaN without a vehicle
    return np.asarray((apart <= distance_m).any(axis=1))


def score_method(method: Method, windows: Windows, horizon: int, generator: torch.Generator) -> Scores:
    """Returns a method's scores at one horizon; for several, or for subsets, ask `measure` once."""
    return measure(method, windows, (horizon,), generator).scores(horizon)


@torch.inference_mode()
def measure(
    method: Method, windows: Windows, horizons: Sequence[int], generator: torch.Generator, pedestrians: int = 1024
) -> Measured:
    """Asks the method for every scene once and measures everybody who is scored at the shortest horizon.

    Raises ValueError if that is nobody, or if the windows end before a horizon.
    """
    P = windows.future.shape[1]
    if not horizons or not 0 < min(horizons) <= max(horizons) <= P:
        raise ValueError(f"horizons must be 1 to {P} steps, got {tuple(horizons)}")
    chosen = scorable(windows, min(horizons))
    if not chosen.any():
        raise ValueError(f"nobody has a complete history and a future known for {min(horizons)} steps")
    rows, counts, steps = [], [], []
    paths: dict[int, list[PathFigures]] = {horizon: [] for horizon in horizons}
    for batch, forecast, scored in _forecasts(method, windows, chosen, generator, pedestrians):
        rows.append(batch.row[scored].numpy())
        counts.append((forecast.paths.probabilities[scored] > 0).sum(dim=-1).numpy())
        truth = batch.future[scored]  # (B, P, 2)
        likelihoods, draws = _distribution_figures(forecast, scored, truth, generator)
        steps.append(StepFigures(**_error_figures(forecast, batch, scored), **likelihoods))
        for horizon in horizons:
            paths[horizon].append(_path_figures(forecast, scored, truth, draws, horizon))
    row = np.concatenate(rows)
    known = windows.known[row]
    return Measured(
        dt_s=windows.dt_s,
        rows=row,
        reach=np.where(known.all(axis=1), P, known.argmin(axis=1)),
        modal_paths=np.concatenate(counts),
        steps=_joined(steps),
        paths={horizon: _joined(parts) for horizon, parts in paths.items()},
    )


@torch.inference_mode()
def quick_scores(
    method: Method,
    windows: Windows,
    generator: torch.Generator | None = None,
    among: BoolArray | None = None,
    pedestrians: int = 2048,
) -> QuickScores:
    """Returns the scores that cost no more than the forecasts, at the windows' whole horizon.

    Over the rows where `among` (N,) is true, by default those that are scored; their futures must be known throughout.
    """
    P = windows.future.shape[1]
    chosen = scorable(windows, P) if among is None else among & windows.known.all(axis=1)
    if not chosen.any():
        raise ValueError(f"nobody to score: no complete history with a future known for {P} steps")
    draws = torch.Generator().manual_seed(0) if generator is None else generator
    sums, nll, count = np.zeros(4), 0.0, 0
    for batch, forecast, scored in _forecasts(method, windows, chosen, draws, pedestrians):
        answers, truth = _answers(forecast)[scored].numpy(), batch.future[scored]
        true = truth.numpy()[:, None]
        errors = (metrics.ade(answers, true), metrics.fde(answers, true), metrics.mhd(answers, true))
        modal = (forecast.paths.probabilities[scored] > 0).sum()
        sums += [*(float(error.mean(axis=1).sum()) for error in errors), float(modal)]
        mixture = distribution_metrics.take(forecast.mixture, scored)
        nll -= float(log_likelihood(mixture, truth).mean(dim=-1).sum())
        count += len(truth)
    ade, fde, mhd, modal_paths = (sums / count).tolist()
    return QuickScores(count, ade, fde, mhd, nll / count, modal_paths)


def _forecasts(
    method: Method, windows: Windows, chosen: BoolArray, generator: torch.Generator, pedestrians: int
) -> Iterator[tuple[Batch, Forecast, Tensor]]:
    """Yields the scenes with somebody to score in batches, their forecasts, and who that is, (S, A) bool."""
    wanted = np.bincount(windows.scene, chosen)[windows.scene] > 0
    rows = np.flatnonzero(wanted)
    for batch in batches(windows.select(wanted), pedestrians):
        row = torch.from_numpy(rows)[batch.row]
        scored = batch.real & torch.from_numpy(chosen)[row]
        yield replace(batch, row=row), method.forecast(batch.observation, generator), scored


def _answers(forecast: Forecast) -> Tensor:
    """(..., N, P, 2): the paths whose errors are averaged, the most probable one or 10 samples."""
    if forecast.samples is not None:
        return forecast.samples[..., :AVERAGED_SAMPLES, :, :]
    return forecast.likeliest.unsqueeze(-3)


def _error_figures(forecast: Forecast, batch: Batch, scored: Tensor) -> dict[str, FloatArray]:
    """Errors, misses and collisions of the answers, (B, P) each."""
    answers = _answers(forecast)  # (S, A, N, P, 2)
    error = (answers[scored] - batch.future[scored].unsqueeze(-3)).norm(dim=-1).numpy()  # (B, N, P)
    known, chosen = batch.known.numpy(), scored.numpy()
    collided = [_collided_by(path, known, chosen) for path in np.moveaxis(answers.numpy(), 2, 0)]
    return {
        "error_m": error.mean(axis=1),
        "missed": (error > metrics.MISS_M).mean(axis=1),
        "collided": np.mean(collided, axis=0),
        "truly_collided": _collided_by(batch.future.numpy(), known, chosen).astype(np.float64),
    }


def _collided_by(path: FloatArray, known: BoolArray, scored: BoolArray) -> BoolArray:
    """(S, A, P, 2), (S, A, P), (S, A) -> (B, P): who has collided by which step, of those who are still there."""
    return np.logical_or.accumulate(metrics.collided(path, known)[scored], axis=1)


def _path_figures(forecast: Forecast, scored: Tensor, truth: Tensor, draws: Tensor, horizon: int) -> PathFigures:
    true = truth.numpy()[:, None, :horizon]  # (B, 1, h, 2)
    answers = _answers(forecast)[scored].numpy()[..., :horizon, :]  # (B, N, h, 2)
    modal = forecast.paths.points[scored].numpy()[..., :horizon, :]  # (B, L, h, 2); empty ones repeat a real path
    drawn = draws.numpy()[..., :horizon, :]
    return PathFigures(
        mhd=metrics.mhd(answers, true).mean(axis=1),
        min_ade=metrics.ade(modal, true).min(axis=1),
        min_fde=metrics.fde(modal, true).min(axis=1),
        min_ade_20=metrics.ade(drawn, true).min(axis=1),
        min_fde_20=metrics.fde(drawn, true).min(axis=1),
    )


def _distribution_figures(
    forecast: Forecast, scored: Tensor, truth: Tensor, generator: torch.Generator
) -> tuple[dict[str, FloatArray], Tensor]:
    """Returns figures of the mixtures (B, P), and up to 20 paths drawn of each pedestrian (B, 20, P, 2).

    Methods with samples answer with these; of the others, paths are drawn from the mixture.
    """
    mixture = distribution_metrics.take(forecast.mixture, scored)
    own = None if forecast.samples is None else forecast.samples[scored]
    parts, drawn = [], []
    for start in range(0, len(truth), _CHUNK):
        chunk = slice(start, start + _CHUNK)
        count = KDE_SAMPLES if own is None else DENSITY_SAMPLES
        part = distribution_metrics.take(mixture, chunk)
        paths = distribution_metrics.sample_paths(part, count, generator)  # (B', M, P, 2)
        samples = paths if own is None else own[chunk]
        parts.append(_of_mixture(part, paths.transpose(1, 2), samples.transpose(1, 2), truth[chunk], generator))
        drawn.append(samples[:, :BEST_OF])
    names = ("nll", "kde_nll", "rank", "area_90_m2")
    columns = zip(*parts, strict=True)
    figures = {name: torch.cat(column).numpy() for name, column in zip(names, columns, strict=True)}
    return figures, torch.cat(drawn)


def _of_mixture(
    mixture: GaussianMixture, points: Tensor, samples: Tensor, truth: Tensor, generator: torch.Generator
) -> tuple[Tensor, ...]:
    """Points (B, P, M, 2) of the mixture, the method's samples likewise -> nll, kde_nll, rank, area (B, P) each."""
    log_density = log_likelihood(mixture, truth)
    densities = distribution_metrics.densities(mixture, points[:, :, :DENSITY_SAMPLES])
    return (
        -log_density,
        -distribution_metrics.kde_log_density(samples, truth),
        distribution_metrics.density_ranks(densities, log_density.exp(), generator),
        distribution_metrics.region_areas(densities),
    )


def _joined(parts: list[Figures]) -> Figures:
    kind = type(parts[0])
    return kind(**{f.name: np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(kind)})
