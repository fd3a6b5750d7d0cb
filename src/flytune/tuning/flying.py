"""The flights of a tuning."""

from flytune.control.policy import Policy
from flytune.evaluation.fly import fly
from flytune.evaluation.judge import Judgement, judge
from flytune.task.task import Task
from flytune.tuning.requirement import Requirement


def fly_for(requirement: Requirement, policy: Policy, task: Task, seed: int, trials: int) -> Judgement:
    """The judgement of a policy on trials that are long enough for the requirement."""
    return judge(fly(policy, task, trials=trials, seed=seed, duration=requirement.trial_duration()))
