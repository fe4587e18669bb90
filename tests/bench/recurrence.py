"""What faults that recur in instructions cost: flights beside their golden twins, in turns, and one replay.

Run it with ``python -m tests.bench.recurrence [TIMES]`` on a checkout; 3 times by default. It prints a line
for each fault: strikes, the wall times of twins and of faulty flights, and the answer of the replay.
"""

from __future__ import annotations

import sys

from deploy.config.written_faults import parse_fault
from deploy.mission.fork_server import ForkServer
from deploy.pairing.golden_twin import PairFlyer
from deploy.pairing.replay import refusal, replay
from services.models.mission import MissionSpec

FAULTS = (
    "recurrence=permanent,opcodes=vmulsd,bit_numbers=0",
    "recurrence=intermittent,probability=0.005,register_class=vector,bit_numbers=0",
    "recurrence=intermittent,probability=0.1,register_class=vector,model=none",
    "recurrence=rate,rate_hz=1000.0,register_class=vector,bit_numbers=0",
)
"""All strike ``pid`` where it does little harm: the flights are to be as long as their twins."""


def main(times: int) -> None:
    """Measure each fault and print what it cost."""
    server = ForkServer()
    golden = MissionSpec(seed=7)
    flyer = PairFlyer(server)
    flyer.fly(golden)
    for text in FAULTS:
        spec = golden.model_copy(update={"fault": parse_fault(f"instruction:pid,{text}", 0, "calls")})
        twins, faulty = [], []
        for _ in range(times):
            twins.append(PairFlyer(server).fly(golden).wall_s)
            outcome = flyer.fly(spec)
            faulty.append(outcome.wall_s)
        record = outcome.injection
        strikes = record.strikes if record is not None else 0
        answer = refusal(outcome) or replay(outcome, server).answer
        ranges = [f"{min(took):.2f} to {max(took):.2f} s" for took in (twins, faulty)]
        print(f"{text}: {strikes} strikes, twin {ranges[0]}, faulty {ranges[1]}, {answer}", flush=True)
    server.close()


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 3)
