"""How many injections replay to the same record and the same outcome.

``python -m tests.bench.replay [INJECTIONS] [FIRST SEED]``: each is recorded on one fork server and replayed
on another, kernels in turn. Divergences are told as they come.
"""

import sys
from collections import Counter

from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import PairFlyer
from deploy.pairing.replay import replay
from services.models.faults.specification import FaultSpec
from services.models.mission import Limits, MissionSpec

TARGETS = ("pid", "trajectory", "pid", "collision_check", "point_cloud", "octomap", "rrt_star")
SPEC = MissionSpec(world="sparse", seed=7, limits=Limits(mission_time_s=8.0))


def main() -> None:
    injections, first = (int(given) for given in (*sys.argv[1:], *("100", "0")[len(sys.argv) - 1 :]))
    recorder, repeater = ForkServer(), ForkServer()
    pairs = PairFlyer(recorder)
    answers: Counter[tuple[str, str]] = Counter()
    for number in range(first, first + injections):
        target = TARGETS[number % len(TARGETS)]
        outcome = pairs.fly(SPEC.model_copy(update={"fault": FaultSpec(target=target, seed=number)}))
        record = outcome.injection
        assert record is not None
        if record.trigger is None or record.trigger.site is None:
            answers[record.precision, f"not replayable: {record.status}"] += 1
            continue
        answer = replay(outcome, repeater)
        answers[record.precision, answer.answer] += 1
        if answer.answer != "replayed":
            where = f"{target}, seed {number}, {record.precision}, {record.symbol}"
            print(f"{where}: {'; '.join(answer.differences)}")
    for (precision, what), count in sorted(answers.items()):
        print(f"{precision:12} {what:14} {count}")
    repeater.close()
    recorder.close()


if __name__ == "__main__":
    main()
