"""Table 1 and Figure 2 of Kovač & Farkaš 2023, run again: ``make paper``.

PPO and constrained PPO with Cartesian (AR1) and joint (AR2) actions, in the paper's environment
with the paper's settings (those of OpenAI's safety-starter-agents, which the authors' code uses).
To resume it, repeat the command: it runs what is missing.
"""

from __future__ import annotations

import dataclasses
from itertools import product
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
import torch
import tyro
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch.distributions.transforms import SoftplusTransform
from torchrl import torchrl_logger
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, RewardSum, TransformedEnv
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, ValueOperator

from experiments.grid import check_grid, run_grid, save_results
from experiments.report import LEARNING, Line, mean_of_known, plot_learning
from experiments.style import colour
from experiments.tables import markdown
from torchrl_safe._checks import check_count, check_not_negative
from torchrl_safe._cores import cores
from torchrl_safe.envs import PAPER_CARTESIAN, PAPER_JOINT, ActionMode, paper_env
from torchrl_safe.evaluation import evaluate
from torchrl_safe.objectives import DualAscent, PPOLagrangianLoss

ACTIONS: dict[str, ActionMode] = {"AR1": PAPER_CARTESIAN, "AR2": PAPER_JOINT}
ALGORITHMS = ("PPO", "cPPO")
CELLS = tuple(f"{action} {algorithm}" for action, algorithm in product(ACTIONS, ALGORITHMS))
# Mean and standard deviation of "Average Cost": Table 1 of the paper, and the authors' code run
# again with four seeds (on PyBullet 3.2.7, algorithm unchanged).
PAPER = {
    "AR1 PPO": (17.6, 1.3),
    "AR1 cPPO": (11.9, 3.6),
    "AR2 PPO": (23.8, 5.0),
    "AR2 cPPO": (17.0, 1.9),
}
RERUN = {
    "AR1 PPO": (18.9, 2.2),
    "AR1 cPPO": (14.4, 2.3),
    "AR2 PPO": (22.5, 4.6),
    "AR2 cPPO": (18.1, 1.9),
}
RERUN_SUCCESS = {"AR1 PPO": 0.85, "AR1 cPPO": 0.78, "AR2 PPO": 0.74, "AR2 cPPO": 0.65}
# Worlds side by side, each playing 500 steps from a reset: an epoch has room for one episode of
# full length in each, as it has for two in the paper, whose one world plays 1000 steps. (With more
# and shorter ones, most early epochs end no episode, and the multiplier hardly leaves its start.)
_WORLDS = 2
_LATE = 20


@dataclasses.dataclass(frozen=True)
class Config:
    """Run the paper's four experiments again."""

    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds of the runs."""
    epochs: int = 200
    """Batches of 1000 control steps."""
    cost_limit: float = 25.0
    """Limit of the expected cost of an episode, in control steps with a contact."""
    jobs: int = cores()
    """Runs side by side."""
    eval_episodes: int = 100
    """Episodes of the final evaluation of each run, with the deterministic policy."""
    out: Path = Path("runs/paper")
    """Folder of results; runs that are already there are not run again."""

    def __post_init__(self) -> None:
        check_grid(self, "seeds")
        check_count(epochs=self.epochs, eval_episodes=self.eval_episodes)
        check_not_negative(cost_limit=self.cost_limit)


def make_env(action: str, num_envs: int, seed: int) -> EnvBase:
    """Makes the paper's environment with the sums of reward and cost over each episode."""
    env = paper_env(ACTIONS[action], num_envs=num_envs, seed=seed)
    sums = RewardSum(["reward", "cost"], ["episode_reward", "episode_cost"])
    return TransformedEnv(env, sums)


def make_agent(env: EnvBase) -> tuple[ProbabilisticActor, PPOLagrangianLoss]:
    """Makes a Gaussian policy and the loss: tanh networks of 2 x 64, gamma .99, lambda .97."""
    width, actions = env.observation_spec["observation"].shape[-1], env.action_spec.shape[-1]

    def network(outputs: int) -> MLP:
        return MLP(width, outputs, num_cells=[64, 64], activation_class=torch.nn.Tanh)

    scale = AddStateIndependentNormalScale(actions, init_value=-0.5)
    actor = ProbabilisticActor(
        TensorDictModule(
            torch.nn.Sequential(network(actions), scale), ["observation"], ["loc", "scale"]
        ),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    loss = PPOLagrangianLoss(
        actor,
        ValueOperator(network(1), in_keys=["observation"]),
        ValueOperator(network(1), in_keys=["observation"], out_keys=["cost_value"]),
        entropy_bonus=False,
        loss_critic_type="l2",
        normalize_cost_advantage=False,  # As in the paper, where multipliers have a unit.
    )
    loss.make_value_estimator(gamma=0.99, lmbda=0.97, vectorized=True)
    loss.make_cost_value_estimator(gamma=0.99, lmbda=0.97, vectorized=True)
    return actor, loss


def run(cell: str, seed: int, epochs: int, cost_limit: float, eval_episodes: int) -> dict[str, Any]:
    """Trains and evaluates one policy."""
    torchrl_logger.setLevel("WARNING")
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    action, algorithm = cell.split()
    start = perf_counter()
    env = make_env(action, _WORLDS, seed)
    actor, loss = make_agent(env)
    updater = None
    if algorithm == "cPPO":
        loss.lagrange_multiplier.fill_(1.0)
        updater = DualAscent(
            loss,
            cost_limit=cost_limit,
            lr=0.05,
            optimizer=torch.optim.Adam,
            parametrization=SoftplusTransform(),
        )
    critics = [*loss.critic_network_params.values(True, True)]
    critics += loss.cost_critic_network_params.values(True, True)
    policy_optimizer = torch.optim.Adam(loss.actor_network_params.values(True, True), lr=3e-4)
    critic_optimizer = torch.optim.Adam(critics, lr=1e-3)
    collector = Collector(
        env,
        actor,
        frames_per_batch=1000,
        total_frames=1000 * epochs,
        reset_at_each_iter=True,
        auto_register_policy_transforms=False,
    )
    history = []
    for batch in collector:
        ended = batch["next"][batch["next", "done"].squeeze(-1)]
        if updater is not None:
            updater.step(ended["episode_cost"])
        data = loss.estimate_advantages(batch).reshape(-1)
        update(loss, data, policy_optimizer, critic_optimizer)
        history.append(
            {
                "episodes": len(ended),
                "cost": ended["episode_cost"].sum().item(),
                "return": ended["episode_reward"].sum().item(),
                "success": ended["success"].sum().item(),
                "multiplier": loss.lagrange_multiplier.item(),
            }
        )
    collector.shutdown()
    test = make_env(action, min(20, eval_episodes), seed)
    episodes = evaluate(test, actor, eval_episodes, seed=seed + 1_000_000)
    test.close()
    return {
        "cell": cell,
        "seed": seed,
        "seconds": perf_counter() - start,
        "history": history,
        "evaluation": {
            "success": episodes["success"].float().mean().item(),
            "return": episodes["episode_reward"].mean().item(),
            "cost": episodes["episode_cost"].mean().item(),
            "touched": (episodes["episode_cost"] > 0).float().mean().item(),
        },
    }


def update(
    loss: PPOLagrangianLoss,
    data: Any,
    policy_optimizer: torch.optim.Optimizer,
    critic_optimizer: torch.optim.Optimizer,
) -> None:
    """Takes 80 steps on the whole batch; the policy stops when it has moved too far."""
    moves = True
    for _ in range(80):
        losses = loss(data)
        moves = moves and losses["kl_approx"].item() <= 1.2 * 0.01
        total = losses["loss_critic"] + losses["loss_cost_critic"]
        (total + losses["loss_objective"] if moves else total).backward()
        critic_optimizer.step()
        if moves:
            policy_optimizer.step()
        critic_optimizer.zero_grad()
        policy_optimizer.zero_grad()


def jobs(config: Config) -> dict[Path, tuple[str, int, int, float, int]]:
    """What to run, by the file of its results."""
    settings = (config.epochs, config.cost_limit, config.eval_episodes)
    return {
        config.out / f"{cell.replace(' ', '-')}-{seed}.json": (cell, seed, *settings)
        for seed, cell in product(config.seeds, CELLS)
    }


def per_epoch(run: dict[str, Any], name: str) -> np.ndarray:
    """Mean over the episodes that ended in each epoch; NaN where none did."""
    episodes = np.array([row["episodes"] for row in run["history"]], float)
    total = np.array([row[name] for row in run["history"]], float)
    return np.divide(total, episodes, out=np.full_like(total, np.nan), where=episodes > 0)


def table(runs: list[dict[str, Any]]) -> str:
    """Returns the paper's Table 1, with what it leaves out, in Markdown."""
    heads = (
        "", "average cost: paper", "authors' code again", "here",
        "final success: authors' code again", "here",
        "evaluated: success", "cost", "episodes with a touch",
    )  # fmt: skip
    rows = []
    for cell in CELLS:
        mine = [run for run in runs if run["cell"] == cell]
        average = [mean_of_known(per_epoch(run, "cost")) for run in mine]
        late = [mean_of_known(per_epoch(run, "success")[-_LATE:]) for run in mine]
        test = {
            name: [run["evaluation"][name] for run in mine]
            for name in ("success", "cost", "touched")
        }
        rows.append(
            (
                cell,
                _spread(*PAPER[cell]),
                _spread(*RERUN[cell]),
                _over_seeds(average),
                f"{RERUN_SUCCESS[cell]:.2f}",
                _over_seeds(late, 2),
                _over_seeds(test["success"], 2),
                _over_seeds(test["cost"]),
                f"{np.mean(test['touched']):.0%}",
            )
        )
    return markdown(heads, rows)


def plot(runs: list[dict[str, Any]], path: Path, cost_limit: float) -> None:
    """Draws the paper's Figure 2, a row for each kind of action."""

    def lines(action: str, name: str) -> list[Line]:
        return [
            Line(
                algorithm,
                colour("ppo" if algorithm == "PPO" else "ppo-lagrangian"),
                [
                    per_epoch(run, name).tolist()
                    for run in runs
                    if run["cell"] == f"{action} {algorithm}"
                ],
            )
            for algorithm in ALGORITHMS
        ]

    rows = {action: {name: lines(action, name) for name in LEARNING} for action in ACTIONS}
    plot_learning(rows, path, frames_per_point=1000, width=10, limits=(cost_limit,))


def main(config: Config) -> None:
    """Runs what is missing, then writes table, figure and results.json."""
    runs = run_grid(run, jobs(config), workers=config.jobs, name="paper")
    save_results(config.out, config, runs, table(runs))
    plot(runs, config.out / "curves.png", config.cost_limit)


def _over_seeds(values: list[float], digits: int = 1) -> str:
    return _spread(float(np.mean(values)), float(np.std(values)), digits)


def _spread(mean: float, deviation: float, digits: int = 1) -> str:
    return f"{mean:.{digits}f} ± {deviation:.{digits}f}"


if __name__ == "__main__":
    main(tyro.cli(Config))
