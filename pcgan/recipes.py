"""How each method is built and trained: the published way (`paper`), and the strongest we found (`best`).

Every choice in `best` was made on validation cuts of training scenes (docs/results.md has the trials).
"""

from dataclasses import dataclass, field, replace

from pcgan.batches import Augmentation
from pcgan.learners import GeneratorLearner, Learner, LossWeights
from pcgan.learners_baselines import SganLearner, SrLstmLearner
from pcgan.model import Generator, ModelConfig
from pcgan.sgan import SganConfig, SganGenerator
from pcgan.sr_lstm import SrLstm, SrLstmConfig

LEARNED = ("sgan", "srlstm", "psgan", "pcgan")
RECIPES = ("paper", "best")
NOISE_MPS = 0.15  # observation noise up to 6 cm at 2.5 Hz, and as much of a velocity error at other rates
PAPER_SHARE = 0.25  # 100 epochs are then some 4,000 updates; `best` makes twice as many
NetworkConfig = ModelConfig | SganConfig | SrLstmConfig


@dataclass(frozen=True)
class Recipe:
    """A network and its training, whatever the data."""

    network: NetworkConfig
    epochs: int
    learning_rate: float = 1e-3
    batch_pedestrians: int = 256
    one_cycle: bool = False
    ema: float = 0.0  # the saved weights are an average over the run with this decay; 0: the last ones
    loss: LossWeights = field(default_factory=LossWeights)
    augmentation: Augmentation = field(default_factory=Augmentation)
    reversed_share: float = 0.0  # this share of windows run backwards in time
    share: float = 1.0  # of the windows that an epoch draws; they overlap, each is 0.4 s from the next
    crowd_share: float = 0.3  # and of the windows of UCY's crowded files, which are most of all, this share is drawn
    complete_only: bool = False  # only pedestrians seen throughout, with a known future, exist

    def learner(self) -> Learner:
        """Returns a learner with fresh weights, which draw on torch's global generator."""
        if isinstance(self.network, SganConfig):
            return SganLearner(SganGenerator(self.network), self.learning_rate, self.epochs)
        if isinstance(self.network, SrLstmConfig):
            return SrLstmLearner(SrLstm(self.network), self.learning_rate, self.epochs)
        return GeneratorLearner(Generator(self.network), self.loss, self.learning_rate)


@dataclass(frozen=True)
class Task:
    """What is predicted from what: steps, their length, and whether there is a vehicle."""

    observed_steps: int = 8
    predicted_steps: int = 12
    dt_s: float = 0.4
    uses_vehicle: bool = False
    epochs: int | None = None  # of `best`, where the data are not worth its usual number


def recipe_for(method: str, recipe: str = "best", task: Task = Task()) -> Recipe:
    """Returns a method's recipe; SGAN and SR-LSTM have one, whatever is asked for. Raises ValueError for others."""
    if recipe not in RECIPES:
        raise ValueError(f"recipe must be one of {RECIPES}, got {recipe!r}")
    steps = {"observed_steps": task.observed_steps, "predicted_steps": task.predicted_steps}
    paper = Recipe(
        SganConfig(**steps, dt_s=task.dt_s), epochs=100, batch_pedestrians=128, share=PAPER_SHARE, complete_only=True
    )
    if method == "sgan":
        return paper
    if method == "srlstm":
        return replace(
            paper, network=SrLstmConfig(**steps, dt_s=task.dt_s), epochs=40, learning_rate=1.5e-3, batch_pedestrians=256
        )
    if method not in LEARNED:
        raise ValueError(f"no method {method!r} that learns; there are {LEARNED}")
    pooling = {"psgan": "social", "pcgan": "gvat"}[method]
    uses_vehicle = task.uses_vehicle and method == "pcgan"
    network = ModelConfig(recipe=recipe, pooling=pooling, **steps, dt_s=task.dt_s, uses_vehicle=uses_vehicle)
    if recipe == "paper":
        loss = LossWeights(likelihood=0.1, path=0.0, adversarial=1.0, adversarial_from=10)
        return replace(paper, network=network, loss=loss)
    return Recipe(
        network,
        epochs=task.epochs or 30,
        batch_pedestrians=128,
        learning_rate=3e-3,
        one_cycle=True,
        ema=0.999,
        augmentation=Augmentation(
            NOISE_MPS * task.dt_s, scale=0.3, forget=0.2, hide_vehicle=0.1 if uses_vehicle else 0.0
        ),
        reversed_share=0.3,
    )
