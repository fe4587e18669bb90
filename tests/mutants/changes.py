"""The list: each change is one that a person could make by mistake and that a user would suffer from."""

from typing import NamedTuple


class Mutant(NamedTuple):
    """``old``, which is in the file exactly once, becomes ``new``; one of ``tests`` must fail then."""

    name: str
    path: str
    old: str
    new: str
    tests: tuple[str, ...]


def _of(path: str, tests: str, *changes: tuple[str, str, str]) -> list[Mutant]:
    """Changes of one file that the same tests (separated by spaces) must notice."""
    return [Mutant(name, path, old, new, tuple(tests.split())) for name, old, new in changes]


MUTANTS: list[Mutant] = [
    *_of(
        "injector/attach/process_copy.py",
        "tests/injector/attach/test_counted_copy.py",
        ("process copy: its end is told by SIGCHLD", "_CLONE_FILES = 0x400\n", "_CLONE_FILES = 0x411\n"),
        (
            "process copy: who is left alone leaves a child",
            '_BURY = b"\\x89\\xc7"',
            '_BURY = b"\\x31\\xff"',
        ),
        (
            "process copy: a filter's program is copied",
            '.split(maxsplit=1)[0] != "0"',
            '.split(maxsplit=1)[0] == "3"',
        ),
        (
            "process copy: it writes what others share",
            "            for shared in process.maps().shared():\n",
            "            for shared in ():\n",
        ),
    ),
    *_of(
        "injector/attach/call_approach.py",
        "tests/injector/attach/test_counted_copy.py",
        (
            "call approach: one pass too many after the way",
            "way.rest if way is not None else drawn.hit)",
            "way.rest + 1 if way is not None else drawn.hit)",
        ),
    ),
    *_of(
        "injector/attach/counted_copy.py",
        "tests/injector/attach/test_counted_copy.py",
        (
            "counted copy: it asks the kernel for anything",
            "if asked is not None and not self._is_harmless(asked):",
            "if asked is not None and False:",
        ),
    ),
    *_of(
        "services/models/oracles/properties.py",
        "tests/services/models/oracles/test_properties.py",
        ("properties: <= counts as >=", "    if not wanted.at_least:\n", "    if False:\n"),
        (
            "properties: the value that holds at the interval's beginning is left out",
            'wanted.from_s, side="right")) - 1, 0)',
            'wanted.from_s, side="left")), 0)',
        ),
        ("properties: a margin of nothing violates", "holds = robustness >= 0.0", "holds = robustness > 0.0"),
    ),
    *_of(
        "deploy/mission/judgement.py",
        "tests/deploy/mission/test_harm.py",
        (
            "judgement: what the twin violates, too, is harm",
            "for one in twin.properties if one.holds}",
            "for one in twin.properties}",
        ),
        (
            "judgement: the deviation is to points",
            "found = np.minimum(found, np.linalg.norm(points - foot, axis=1))",
            "found = np.minimum(found, found)",
        ),
        (
            "judgement: a mission that the twin loses, too, is harm",
            "    if twin.qof.success:\n",
            "    if True:\n",
        ),
    ),
    *_of(
        "services/runtime/bus_proxy.py",
        "tests/deploy/mission/test_misbehaviour.py",
        (
            "proxy: a node that is restarted waits for those that have ended",
            "if self._setup.life == 0 else set()",
            "if self._setup.life >= 0 else set()",
        ),
    ),
    *_of(
        "deploy/workers/client.py",
        "tests/test_starts.py",
        ("workers: packages in the folder of the command are taken for ours", '"-P", "-m"', '"-m"'),
    ),
    *_of(
        "deploy/mission/flight.py",
        "tests/deploy/mission/test_misbehaviour.py",
        (
            "flight: what keeps a node waiting after its restart is a hang of the fault's",
            "(struck.life > 0 and not fault.recurs)",
            "(struck.life > 9 and not fault.recurs)",
        ),
    ),
    *_of(
        "services/bus/horizon.py",
        "tests/services/bus/test_horizon.py",
        (
            "horizon: promises one message early",
            "self._promises[0][0] <= self._next_seq:",
            "self._promises[0][0] <= self._next_seq + 1:",
        ),
        (
            "horizon: a trigger at the moment the stage is free waits",
            "if head.ready_ns >= busy_until_ns:",
            "if head.ready_ns > busy_until_ns:",
        ),
        (
            "horizon: a busy stage does not wait for triggers of its last moment",
            "if trigger.horizon_ns > busy_until_ns else None",
            "if trigger.horizon_ns >= busy_until_ns else None",
        ),
        ("horizon: a promise before the stage is free", "return max(busy_until_ns, start)", "return start"),
        (
            "horizon: a promise knows no message that is here",
            "start = trigger.head.ready_ns if trigger.head is not None else trigger.horizon_ns",
            "start = trigger.horizon_ns",
        ),
        (
            "horizon: inclusive means before",
            "limit = until_ns + 1 if inclusive else until_ns",
            "limit = until_ns",
        ),
        (
            "horizon: an old promise takes back a newer one",
            "self._horizon_ns = max(self._horizon_ns, self._promises.popleft()[1])",
            "self._horizon_ns = self._promises.popleft()[1]",
        ),
        (
            "horizon: a restarted stage misses the message of its first moment",
            "if successor.ready_ns >= self._ignore_before_ns:",
            "if successor.ready_ns > self._ignore_before_ns:",
        ),
        (
            "horizon: a doubled early message is not counted",
            "if message.seq < self._next_seq or message.seq in self._early:",
            "if message.seq < self._next_seq:",
        ),
    ),
    *_of(
        "deploy/recording/recorder.py",
        "tests/deploy/recording/test_recorder.py",
        (
            "recorder: the digest ignores when a message is ready",
            "hashlib.blake2b(stamp + message.payload,",
            "hashlib.blake2b(message.payload,",
        ),
        (
            "recorder: the digest ignores the topic",
            "whole.update(topic.encode())",
            "whole.update(b'')",
        ),
        (
            "recorder: what is ready at the end is left out",
            "[message for message in history if message.ready_ns <= end_ns]",
            "[message for message in history if message.ready_ns < end_ns]",
        ),
        (
            "recorder: complete before the end's last moment is promised",
            "all(channel.horizon_ns > end_ns for",
            "all(channel.horizon_ns >= end_ns for",
        ),
        (
            "recorder: one silent topic completes a flight",
            "return all(channel.horizon_ns > end_ns",
            "return any(channel.horizon_ns > end_ns",
        ),
        ("recorder: a new life begins within the old one", "return max(ends)", "return min(ends)"),
        (
            "recorder: a new life misses the latched message",
            'start[topic.name] = max(first - 1, 0) if topic.qos == "latched" else first',
            "start[topic.name] = first",
        ),
        (
            "recorder: a new life misses the message of its first moment",
            "bisect.bisect_left(history",
            "bisect.bisect_right(history",
        ),
        (
            "recorder: a divergence is told at the later of two times",
            "min(times[number], twin_times[number])",
            "max(times[number], twin_times[number])",
        ),
        (
            "recorder: an older promise replaces a newer one",
            "if message.serial > self._serials[stage]:",
            "if message.serial != self._serials[stage]:",
        ),
        (
            "recorder: messages of an old sequence number are not counted as refused",
            "return self.malformed + sum(channel.duplicates for channel in self._channels.values())",
            "return self.malformed",
        ),
        (
            "recorder: the flight's horizon is that of the fastest topic",
            "return min(channel.horizon_ns for channel in self._channels.values())",
            "return max(channel.horizon_ns for channel in self._channels.values())",
        ),
        (
            "recorder: a late subscriber misses the message it asks for",
            "return self._history[topic][seq:]",
            "return self._history[topic][seq + 1 :]",
        ),
    ),
    *_of(
        "deploy/recording/ordering.py",
        "tests/deploy/recording/test_ordering.py",
        (
            "recorder: messages of one instant come in any order of topics",
            "(one.message.ready_ns, _PLACE[one.topic], one.message.seq)",
            "(one.message.ready_ns, one.message.seq)",
        ),
        (
            "recorder: nothing is held back for events",
            "self._recorder.horizon_ns - self._hold_ns",
            "self._recorder.horizon_ns",
        ),
    ),
    *_of(
        "services/system/peers.py",
        "tests/services/system/test_peers.py",
        ("peers: we are strangers", " and one.uid != us", ""),
        ("peers: a closed socket is root's", 'if fields[9] != "0"', "if True"),
    ),
    *_of(
        "services/runtime/latency.py",
        "tests/services/runtime/test_latency.py",
        (
            "virtual link: the command is not delayed",
            "topic in OVER_LINK else 0",
            'topic == "odometry" else 0',
        ),
        ("virtual link: topics lose the same messages", 'f"link {topic}"', '"link"'),
        ("virtual link: within a tick messages have fates of their own", "sent_ns // TICK_NS", "sent_ns"),
    ),
    *_of(
        "services/perception/node.py",
        "tests/deploy/mission/test_link.py",
        (
            "virtual link: a frame is as old as its way",
            "frame.ready_ns - setup.spec.link.delay_ns",
            "frame.ready_ns",
        ),
    ),
    *_of(
        "dashboard/campaigns/store/sqlite.py",
        "tests/dashboard/campaigns/store/test_store.py",
        (
            "store: a file that goes while it is written to",
            "yield connection\n        self._refuse_another_file()",
            "yield connection",
        ),
        (
            "store: everybody may read it",
            "os.O_WRONLY | os.O_CLOEXEC, 0o600",
            "os.O_WRONLY | os.O_CLOEXEC, 0o644",
        ),
    ),
    *_of(
        "dashboard/studies/ranking.py",
        "tests/dashboard/studies/test_ranking.py",
        (
            "ranks: a fault that did not strike counts as harmless",
            'if result is None or result.injection != "injected" or result.harm is None:',
            "if result is None or result.harm is None:",
        ),
        (
            "ranks: the interval takes the rates alone as known",
            "    for tallies in (alone, flown):\n",
            "    for tallies in (alone, alone):\n",
        ),
    ),
    *_of(
        "dashboard/publication/site.py",
        "tests/dashboard/publication/test_site.py",
        ("publication: what others told is markup", "autoescape=True", "autoescape=False"),
        (
            "publication: a folder with something in it is written over",
            "if folder.exists() and (",
            "if False and (",
        ),
    ),
    *_of(
        "dashboard/analysis/findings.py",
        "tests/dashboard/analysis/test_findings.py",
        ("publication: chance is an effect", "if beside.p_adjusted < SIGNIFICANT:", "if True:"),
    ),
    *_of(
        "dashboard/analysis/why.py",
        "tests/dashboard/analysis/test_why.py",
        ("why: false alarms notice a fault", "if one.true]", "]"),
        (
            "why: a guard of the twin's is the fault's",
            "outcome.acting_guards - set(twins)",
            "outcome.acting_guards",
        ),
    ),
    *_of(
        "dashboard/campaigns/stopping.py",
        "tests/dashboard/campaigns/test_scheduler.py",
        (
            "stopping: a relative precision is one in points",
            "margin = (stop.relative or 0.0) * sum(seen) / max(len(seen), 1)",
            "margin = stop.relative or 0.0",
        ),
        ("stopping: golden cells wait for harm", "if golden_counts or run.spec.fault is not None", ""),
    ),
    *_of(
        "dashboard/studies/sensitivity.py",
        "tests/dashboard/studies/test_sensitivity.py",
        ("map: phases are those of seconds", "/ result.twin_flight_time_s\n", "\n"),
        ("map: the top bit is of the exponent", '"sign" if place == element_bits - 1 else ', ""),
        ("map: what recurs stands in the field of its first strike", "if record.strikes:", "if False:"),
    ),
    *_of(
        "dashboard/studies/recurring.py",
        "tests/dashboard/studies/test_recurring.py",
        (
            "recurring: each ranking is compared with itself",
            "[rates[name] for name in places])",
            "[once[name] for name in places])",
        ),
    ),
    *_of(
        "dashboard/studies/redundant_computers.py",
        "tests/dashboard/studies/test_redundant_computers.py",
        (
            "redundant computers: a fitted input confirms",
            'return "fitted" if airframe in FITTED else "agrees"',
            'return "agrees"',
        ),
        ("redundant computers: every factor agrees", "- 1) > CLOSE:", "- 1) > 1000 * CLOSE:"),
    ),
    *_of(
        "dashboard/studies/paper.py",
        "tests/dashboard/studies/test_paper.py",
        (
            "paper: what was proven counts as a flight that took no time",
            "if not one.proof]",
            "]",
        ),
        ("paper: an overhead is a part and no per cent", "[100 * one.overhead for", "[one.overhead for"),
    ),
    *_of(
        "dashboard/studies/kernels_alone.py",
        "tests/dashboard/studies/test_kernels_alone.py",
        (
            "kernels alone: a rival beyond the interval refutes nothing",
            "        if farthest < 0:\n",
            "        if farthest < -1:\n",
        ),
        (
            "kernels alone: overlapping intervals confirm",
            "        if nearest <= 0:\n",
            "        if nearest <= -1:\n",
        ),
    ),
    *_of(
        "services/planning/goals.py",
        "tests/services/planning/test_goals.py",
        (
            "re-execution: copies of an exploration share what they tried",
            "        self._tried = [*self._tried, found]\n",
            "        self._tried.append(found)\n",
        ),
        (
            "re-execution: of a sweep nothing is compared",
            '        return self._ends.tobytes() + self._index.to_bytes(8, "little")\n',
            '        return b""\n',
        ),
    ),
    *_of(
        "deploy/mission/supervisor.py",
        "tests/deploy/mission/test_flight.py",
        (
            "supervisor: what was killed is waited for without end",
            "            if now_s > begin_s + LEFT_S:\n",
            "            if now_s > begin_s + 1000 * LEFT_S:\n",
        ),
    ),
    *_of(
        "deploy/mission/silence.py",
        "tests/deploy/mission/test_silence.py",
        ("silence: who computes is to blame", " or not computes(self._watched.pids())", " or True"),
        ("silence: spoilt threads compute for ever", "used_s > STALL_S + self._most_cpu_s or", "False or"),
        (
            "silence: the machine's own pause counts",
            "self._quiet_s += min(since_s, LOOK_S)",
            "self._quiet_s += since_s",
        ),
        (
            "silence: who goes on in time is to blame",
            "self._quiet_s, self._stopped_s = 0.0, ",
            "self._stopped_s = ",
        ),
    ),
    *_of(
        "dashboard/campaigns/store/columns.py",
        "tests/dashboard/campaigns/store/test_columns.py",
        (
            "columns: whoever reads sees the array change",
            "rows, new = kept.rows.copy(), rows",
            "rows, new = kept.rows, rows",
        ),
        ("columns: all runs are read again", "RunRow.changed > sa", "RunRow.changed >= sa"),
        ("columns: every campaign is kept", "sum(len(one.rows)", "sum(0 * len(one.rows)"),
    ),
    *_of(
        "dashboard/campaigns/store/store.py",
        "tests/dashboard/campaigns/store/test_columns.py",
        ("columns: a write does not count", "scalar_one()) + 1", "scalar_one())"),
    ),
    *_of(
        "dashboard/campaigns/store/database.py",
        "tests/dashboard/campaigns/store/test_migrations.py",
        (
            "migrations: half a step is left",
            'connection.exec_driver_sql("BEGIN IMMEDIATE")',
            'connection.exec_driver_sql("PRAGMA user_version")',
        ),
    ),
    *_of(
        "dashboard/campaigns/results/detection_effects.py",
        "tests/dashboard/campaigns/results/test_detection_effects.py",
        (
            "effects: further from the twin is recovered",
            "_deviation(flights) < _d",
            "_deviation(flights) > _d",
        ),
    ),
    *_of(
        "dashboard/campaigns/store/columns.py",
        "tests/dashboard/campaigns/test_flight_record.py",
        ("compare: beside another seed", "(wanted >= 0) &", "(wanted >= 0) |"),
    ),
    *_of(
        "dashboard/campaigns/results/compare.py",
        "tests/dashboard/campaigns/test_flight_record.py",
        (
            "compare: lost flights have differences",
            "both = arrived & others_arrived",
            "both = arrived | True",
        ),
        ("compare: runs that were not flown are pairs", '(runs["result"] != None) & ', ""),
    ),
    *_of(
        "dashboard/campaigns/store/backup.py",
        "tests/dashboard/campaigns/store/test_backup.py",
        ("backup: files are not looked for", 'if files == "kept" and not', 'if files == "lost" and not'),
        (
            "backup: what is damaged is put back",
            "if problem := next(problems(copy), None):",
            "if problem := '':",
        ),
    ),
    *_of(
        "dashboard/api/request_limit.py",
        "tests/dashboard/api/test_request_limit.py",
        (
            "limit: requests that have ended still count",
            "                self._at_once -= 1",
            "                pass",
        ),
        ("limit: a pause gives as much as it is long", "min(BURST, self._tokens +", "(self._tokens +"),
    ),
    *_of(
        "dashboard/campaigns/spec.py",
        "tests/dashboard/campaigns/test_spec.py",
        (
            "forecast: golden arms' flights are twins, too",
            "len(struck - golden) * seeds",
            "len(struck) * seeds",
        ),
    ),
    *_of(
        "sim/world.py",
        "tests/sim/test_world.py",
        ("world: any number of places", "if count > MOST_CANDIDATES:", "if False:"),
    ),
    *_of(
        "deploy/config/check.py",
        "tests/deploy/mission/test_own_stack.py",
        ("own stack: Python may ignore its hash seed", 'set(word) & set("IE")', 'set(word) & set("Q")'),
    ),
    *_of(
        "dashboard/api/security.py",
        "tests/dashboard/api/test_security.py",
        (
            "security: WebSockets need no token",
            'if scope["path"] in OPEN or self._bears',
            'if scope["type"] == "websocket" or scope["path"] in OPEN or self._bears',
        ),
        (
            "security: on loopback everybody is our user",
            'tuple(scope["server"])) == os.getuid()',
            'tuple(scope["server"])) is not None',
        ),
        (
            "security: our user needs no token beyond loopback",
            "return self._loopback and self._user_of",
            "return self._user_of",
        ),
        ("security: the group may read the token's file", "if mode & 0o077:", "if mode & 0o007:"),
        ("security: others may read the token's file", "if mode & 0o077:", "if mode & 0o070:"),
        (
            "security: any token is the token",
            "return hmac.compare_digest(_hash(token), hashed)",
            "return bool(token)",
        ),
        (
            "security: pages of another port are ours",
            "urlsplit(origin).netloc != host:",
            "urlsplit(origin).hostname != urlsplit(f'//{host}').hostname:",
        ),
        (
            "security: on loopback any Host is answered",
            "if self._loopback and not is_loopback(",
            "if not self._loopback and not is_loopback(",
        ),
        (
            "security: the token as a password will do",
            'if scheme.lower() != "bearer":',
            'if scheme.lower() not in ("bearer", "basic"):',
        ),
        (
            "security: the token itself is stored",
            'file.write(_hash(token) + "\\n")',
            'file.write(token + "\\n")',
        ),
        (
            "security: others may read a new token",
            "os.fchmod(descriptor, 0o600)",
            "os.fchmod(descriptor, 0o640)",
        ),
        (
            "security: a browser's cookie is not looked at",
            'token = HTTPConnection(scope).cookies.get(COOKIE, "")',
            'token = ""',
        ),
        (
            "security: metrics need no token",
            'OPEN = ("/health", "/ready", "/login", "/favicon.ico")',
            'OPEN = ("/health", "/ready", "/login", "/favicon.ico", "/metrics")',
        ),
        (
            "security: a body without a length may be of any size",
            "            if got > self._most:",
            "            if False:",
        ),
        (
            "security: the length that a body tells is not looked at, nor the body counted",
            "if told.isdecimal() and int(told) > self._most:",
            "await self._app(scope, receive, send)\n        if True:\n            return\n        if False:",
        ),
    ),
    *_of(
        "dashboard/campaigns/scheduler.py",
        "tests/dashboard/campaigns/test_scheduler.py",
        (
            "scheduler: an outcome is written under a stale lease",
            "if isinstance(report.event, Flown) and moved and report.outcome is not None:",
            "if isinstance(report.event, Flown) and report.outcome is not None:",
        ),
        (
            "scheduler: every flight counts as a success",
            "self._rule.add(run.cell, run.index, success=outcome.qof.success, harm=harm)",
            "self._rule.add(run.cell, run.index, success=True, harm=harm)",
        ),
        (
            "scheduler: a run more than the look needs",
            "and run.index < self._rule.released:",
            "and run.index <= self._rule.released:",
        ),
        (
            "scheduler: a lost run is not flown again",
            "            self._queue.appendleft(again)",
            "            pass",
        ),
        (
            "scheduler: a worker whose lease is lost keeps its slot",
            "            self._executor.drop(lease)",
            "            pass",
        ),
        (
            "scheduler: runs of one twin go to several workers",
            "twins.setdefault(run.twin.model_dump_json(), []).append(index)",
            "twins.setdefault(str(index), []).append(index)",
        ),
    ),
    *_of(
        "dashboard/campaigns/state_machine.py",
        "tests/dashboard/campaigns/test_state_machine.py",
        (
            "scheduler: what is reported twice is taken twice",
            "(run in held.runs and self._runs[run].phase == phase)",
            "self._runs[run].phase == phase",
        ),
        (
            "scheduler: one attempt more than allowed",
            "state.attempts >= self._attempts",
            "state.attempts > self._attempts",
        ),
        ("scheduler: leases never end", "if held.until_s < now_s]", "if held.until_s < now_s - 1e9]"),
        (
            "scheduler: a sign of life does not prolong a lease",
            "self._leases[lease].until_s = until_s",
            "pass",
        ),
        (
            "scheduler: an interruption costs an attempt",
            'attempts = run.attempts - (run.phase == "running")',
            "attempts = run.attempts",
        ),
        (
            "scheduler: a campaign with a failed run is done",
            'self.phase = "failed" if self.count("failed") else "done"',
            'self.phase = "done"',
        ),
        (
            "scheduler: a run fails when its worker is lost for the first time",
            'if state.phase == "running" and state.attempts >= self._attempts:',
            'if state.phase == "running":',
        ),
    ),
    *_of(
        "dashboard/web/components/views.py",
        "tests/dashboard/web/components/test_views.py",
        (
            "dashboard: what the first time took is a measure",
            "cost_s = 0.0",
            "pass",
        ),
    ),
    *_of(
        "dashboard/campaigns/stopping.py",
        "tests/dashboard/campaigns/test_scheduler.py",
        (
            "scheduler: flights beyond a look sway it",
            "self._flown[cell].items() if number < self.released]",
            "self._flown[cell].items()]",
        ),
        (
            "scheduler: looks do not share the error",
            "level = 1 - ERROR / len(self._looks)",
            "level = 1 - ERROR",
        ),
        (
            "scheduler: the margin is that of both sides",
            ".width <= 2 * margin",
            ".width <= margin",
        ),
    ),
    *_of(
        "services/perception/collision.py",
        "tests/services/perception/test_collision.py",
        (
            "collision: the body is short of half a voxel",
            "reach = 0.5 * (height_m + resolution_m)",
            "reach = 0.5 * height_m",
        ),
        (
            "collision: the body is thinner by half a voxel",
            "if (x - body[0]) ** 2 + (y - body[1]) ** 2 > radius**2:",
            "if (x - body[0]) ** 2 + (y - body[1]) ** 2 > (radius - 0.5 * resolution) ** 2:",
        ),
        (
            "collision: a vehicle too close can never leave",
            "or (was_near and abs(z - before[2]) <= reach):",
            "or (was_near and False):",
        ),
        (
            "collision: time since midnight",
            "float(times[struck.argmax()] - now_s)",
            "float(times[struck.argmax()])",
        ),
        (
            "collision: the last voxel instead of the first",
            "times[struck.argmax()]",
            "times[struck.nonzero()[0][-1]]",
        ),
        ("collision: counted in every frame", "elif self._known != trajectory_seq:", "else:"),
        (
            "collision: a restarted counter begins again",
            "self.future_collision_seq = max(self.future_collision_seq, answered)",
            "pass",
        ),
        ("collision: steps wider than a voxel", "steps = int(2.0 * length / resolution_m) + 1", "steps = 1"),
        (
            "collision: what was flown already is swept again",
            "begin = (now_s - t0) / (t1 - t0) if t0 < now_s else 0.0",
            "begin = 0.0",
        ),
    ),
    *_of(
        "deploy/compose/state_machine.py",
        "tests/deploy/compose/test_state_machine.py",
        (
            "stack: a process starts while those that restart with it still run",
            "if missing or ending:",
            "if missing:",
        ),
        (
            "stack: who does not come again takes others along",
            "if given_up or not",
            "if not",
        ),
    ),
    *_of(
        "deploy/compose/limits.py",
        "tests/deploy/compose/test_limits.py",
        (
            "limits: pages that a family shares count for each of it",
            "sum(proportional_memory_bytes(pid, stat) for pid, stat in family.items())",
            "sum(stat.memory_bytes for stat in family.values())",
        ),
    ),
    *_of(
        "deploy/compose/probes.py",
        "tests/deploy/compose/test_probes.py",
        (
            "probes: a message of long ago is enough",
            "heard, self._heard = self._heard, False",
            "heard = self._heard",
        ),
    ),
    *_of(
        "services/control/pid.py",
        "tests/services/control/test_pid.py",
        ("pid: yaw gain halved", "_YAW_PROPORTIONAL = 2.0", "_YAW_PROPORTIONAL = 1.0"),
        ("pid: the integral winds up", "_INTEGRAL_LIMIT_M_S = 2.0", "_INTEGRAL_LIMIT_M_S = 200.0"),
        ("pid: turns twice as fast", "= math.radians(90.0)", "= math.radians(180.0)"),
        ("pid: turns the long way", "(end - start + math.pi) % (2.0 * math.pi) - math.pi", "end - start"),
        ("pid: stops too late", "+ 0.5 * duration * velocity[axis]", "+ duration * velocity[axis]"),
        (
            "pid: level speed is limited by axis",
            "command[:2] *= SPEED_LIMIT_M_S / speed",
            "command[0], command[1] = _clip(command[0], SPEED_LIMIT_M_S), _clip(command[1], SPEED_LIMIT_M_S)",
        ),
    ),
    *_of(
        "services/models/pilots.py",
        "tests/services/control",
        ("pid: position gain halved", "proportional_level=1.2", "proportional_level=0.6"),
        ("pid: no derivative part", "derivative=0.15", "derivative=0.0"),
        ("pid: integral gain halved", "integral=0.1", "integral=0.05"),
    ),
    *_of(
        "services/control/curve_follower.py",
        "tests/services/control",
        ("pid: a stop keeps the integral", "            self.state[:] = 0.0\n", ""),
        ("pid: a skipped waypoint leaves its integral", "        self.take_back()\n", ""),
    ),
    *_of(
        "services/control/waypoint_follower.py",
        "tests/services/control",
        (
            "held: a fast point is not held longer",
            "(now_s - self._seen_s) * self._report[PACE]",
            "now_s - self._seen_s",
        ),
        (
            "held: a skipped waypoint stays",
            "        self._index += 1\n        self._left_s = ",
            "        self._left_s = ",
        ),
    ),
    *_of(
        "services/control/collision_stop.py",
        "tests/services/control",
        (
            "pid: brakes for a collision of another trajectory",
            "near and (not self.brake or self.checked == followed)",
            "near",
        ),
        (
            "stop: a collision that is not new counts too",
            "if self.brake or future_collision_seq > self.collisions:",
            "if True:",
        ),
    ),
    *_of(
        "services/control/follower.py",
        "tests/services/control",
        (
            "pid: flies a trajectory that is older than the collision",
            "if future_collision_seq < self._collision.collisions:",
            "if False:",
        ),
    ),
    *_of(
        "services/planning/pilot.py",
        "tests/services/planning",
        (
            "pilot: the baseline plans in flight",
            "if not (self._tactics.leads_on or self._waited(now_s, velocity)):",
            "if False:",
        ),
        (
            "pilot: a guard that is off acts",
            "acts = needed and guard in self._tactics.guards",
            "acts = needed",
        ),
    ),
    *_of(
        "services/bus/message_checks.py",
        "tests/services/bus",
        ("checks: one that is off refuses", "if check in checks and not unless:", "if not unless:"),
    ),
    *_of(
        "services/recovery/recovery.py",
        "tests/services/recovery/test_recovery.py",
        (
            "recovery: one retry more",
            "return self._spec.retries if",
            "return self._spec.retries + 1 if",
        ),
        ("recovery: a dead detector is asked again", "            self._dead = True\n", ""),
        ("recovery: a repetition is not counted", '        self._stage.count("recomputed")\n', ""),
        ("recovery: a repetition costs no time", "cost_ns=self._stage.now_ns - alarmed_ns", "cost_ns=0"),
        (
            "recovery: perception recovers, too",
            '"planning_control": ("planning", "control")',
            '"planning_control": ("perception", "planning", "control")',
        ),
        (
            "recovery: the last alarm is not told",
            "        self._tell(topic, found, action, alarmed_ns)\n",
            "",
        ),
        (
            "recovery: the time of a check does not pass",
            "        self._stage.elapse_check(self._checks)\n",
            "",
        ),
        (
            "recovery: an alarm after publishing drops nothing",
            "drops = self._recovers and judged.before_again is not None",
            "drops = False",
        ),
    ),
    *_of(
        "services/models/faults/arithmetic.py",
        "tests/services/models/faults/test_arithmetic.py",
        ("fault: a flip only sets", "return value ^ mask", "return value | mask"),
        (
            "fault: stuck at the other value",
            "value | mask if fault.stuck_value else value & ~mask",
            "value & ~mask if fault.stuck_value else value | mask",
        ),
        (
            "fault: the exponent has the sign",
            '"exponent": (mantissa, element_bits - 1)',
            '"exponent": (mantissa, element_bits)',
        ),
        ("fault: the mantissa lacks a bit", "{32: 23, 64: 52}", "{32: 22, 64: 51}"),
        ("fault: a bit is drawn twice", "size=fault.bits, replace=False", "size=fault.bits, replace=True"),
        (
            "fault: bits that the operand lacks",
            "if set(fault.bit_numbers) <= set(every) else []",
            "if every else []",
        ),
        (
            "fault: the first number only",
            "for lane in range(0, width_bits, element_bits)",
            "for lane in (0,)",
        ),
        (
            "fault: an operand with just enough bits is passed over",
            "len(bits) >= fault.most_bits",
            "len(bits) > fault.most_bits",
        ),
    ),
    *_of(
        "services/runtime/source_fault.py",
        "tests/services/runtime/test_source_fault.py",
        ("fault: at source level it strikes again", "        self._done = True\n", ""),
        (
            "fault: a point that is not there",
            "if points <= (fault.point or 0):",
            "if points < (fault.point or 0):",
        ),
        (
            "fault: the record names another message",
            '"invocation": number, "virtual_time_ns"',
            '"invocation": number + 1, "virtual_time_ns"',
        ),
    ),
    *_of(
        "dashboard/campaigns/statistics/proportions.py",
        "tests/dashboard/campaigns/statistics/test_proportions.py"
        " tests/dashboard/campaigns/statistics/test_against_statsmodels.py"
        " tests/dashboard/campaigns/statistics/test_medians.py",
        ("statistics: wilson too narrow", "+ z2 / (4 * trials)) / trials)", "+ z2 / (8 * trials)) / trials)"),
        ("statistics: one-sided level", "norm.ppf((1 + level) / 2)", "norm.ppf(level)"),
        ("statistics: holm without its steps", "np.maximum.accumulate(steps)", "steps"),
        ("statistics: bonferroni for holm", "np.arange(len(values), 0, -1)", "len(values)"),
        (
            "statistics: mcnemar counts all pairs",
            "discordant = pairs.first_only + pairs.second_only",
            "discordant = sum(pairs)",
        ),
        (
            "statistics: paired difference without continuity",
            "agreement = max(agreement - n / 2, 0.0)",
            "agreement = max(agreement, 0.0)",
        ),
        ("statistics: paired samples as if independent", "a * a - 2 * phi * a * b + b * b", "a * a + b * b"),
        (
            "statistics: the median's interval is too narrow",
            "float(ordered[outer - 1]), float(ordered[-outer])",
            "float(ordered[outer]), float(ordered[-outer - 1])",
        ),
        (
            "statistics: without trials nothing is known",
            "EVERYTHING = Interval(0.0, 1.0)",
            "EVERYTHING = Interval(0.0, 0.0)",
        ),
    ),
    *_of(
        "dashboard/campaigns/statistics/rare.py",
        "tests/dashboard/campaigns/statistics/test_rare.py",
        (
            "rare: a learned proposal leaves strata out",
            "(1.0 - DEFENSIVE) * errors / errors.sum() + DEFENSIVE * weights",
            "errors / errors.sum()",
        ),
        (
            "rare: draws of a batch are lost",
            "        drawn += asked\n",
            "        drawn = asked\n",
        ),
        (
            "rare: nothing is learned",
            "proposal = shares if batch == 0 else",
            "proposal = shares if batch >= 0 else",
        ),
        (
            "rare: weights of a group are not those of its strata",
            "draw.multinomial(count, weights[one] / weights[one].sum())",
            "draw.multinomial(count, np.full(len(one), 1.0 / len(one)))",
        ),
    ),
    *_of(
        "dashboard/campaigns/statistics/harm_rates.py",
        "tests/dashboard/campaigns/statistics/test_rare.py",
        (
            "rare: strata tell nothing of each other",
            "    return _rates(columns @ effects)\n\n\ndef _rates",
            "    return np.full(len(drawn), overall)\n\n\ndef _rates",
        ),
        (
            "rare: groups are cut anywhere",
            "together.argmin(axis=0)",
            "together.argmax(axis=0)",
        ),
    ),
    *_of(
        "dashboard/campaigns/statistics/sampling.py",
        "tests/dashboard/campaigns/statistics/test_sampling.py",
        ("statistics: weights do not cost any sample", "w.sum() ** 2 / (w @ w)", "float(len(w))"),
        ("statistics: variances weighted once", "variance += share**2 *", "variance += share *"),
        (
            "statistics: a stratum without flights",
            "[int(count) + 1 for count in counts]",
            "[int(count) for count in counts]",
        ),
        ("statistics: infinite population", "(1 + (population - 1) / infinite)", "(1 + 0 / infinite)"),
        (
            "statistics: power is not looked at",
            "spread = float(scipy.stats.norm.ppf(power))",
            "spread = float(scipy.stats.norm.ppf(0.5))",
        ),
    ),
    *_of(
        "dashboard/campaigns/statistics/differences.py",
        "tests/dashboard/campaigns/statistics/test_differences.py",
        (
            "statistics: the bootstrap is another one each time",
            "rng.generator(seed, f",
            "rng.generator(__import__('secrets').randbits(40), f",
        ),
        ("statistics: quantiles biased inwards", "(n + 1) * quantile", "(n - 1) * quantile + 1"),
        ("statistics: neighbours drawn apart", "(1 - first) * draw.beta", "0 * draw.beta"),
    ),
    *_of(
        "injector/reproducible/installed_packages.py",
        "tests/deploy/mission/test_same_memory.py",
        (
            "memory: what all packages offer is read",
            "return every(**wanted) if ours else",
            "return every(**wanted) if ours or wanted else",
        ),
        (
            "memory: site-packages is listed",
            "sys.path_importer_cache[folder] = finder(folder)",
            "finder(folder)",
        ),
        (
            "memory: what packages leave for the beginning is run",
            'return not any(line.startswith(("import ", "import\\t")) for line in file)',
            "return True",
        ),
        ("memory: optional packages are imported", "if name in cls.hidden:", "if not cls.hidden:"),
    ),
    *_of(
        "injector/block_profile/x86_64_translator.py",
        "tests/injector/block_profile/test_x86_64_translator.py",
        (
            "sampling: counting changes flags that are read",
            "if one.rflags_read & _CHANGED_BY_INCREMENT & ~settled:",
            "if False:",
        ),
        (
            "sampling: a shift by a register always sets flags",
            "if not (one.is_string_instruction or by_register):",
            "if not one.is_string_instruction:",
        ),
        ("sampling: blocks overlap", "or (block and one.ip in leaders)", ""),
        (
            "sampling: data beside the code lies elsewhere",
            "if one.is_ip_rel_memory_operand:",
            "if False:",
        ),
        (
            "sampling: a jump over where somebody arrives",
            "begins = address % 16 == 0 or",
            "begins = address % 8 == 0 or",
        ),
    ),
    *_of(
        "injector/block_profile/x86_64_translator.py",
        "tests/injector/block_profile/test_counted_call.py",
        (
            "sampling: a stop just behind where many arrive costs a trap each time",
            "whole, _ = block_of(code, address, ())",
            "whole = list(block_of(code, address, {address + 4})[0])",
        ),
    ),
    *_of(
        "injector/block_profile/instruction_counts.py",
        "tests/injector/block_profile/test_instruction_counts.py",
        (
            "sampling: only the last block's passes",
            "passes[address] = passes.get(address, 0) + often",
            "passes[address] = often",
        ),
        (
            "sampling: addresses alike, not passes",
            "passes = counts.passes.copy()",
            "passes = counts.passes * 0 + 1",
        ),
        (
            "sampling: the first pass is never drawn",
            "1 + int(draw.integers(often))",
            "2 + int(draw.integers(often))",
        ),
        (
            "sampling: a way one pass short",
            "int(passes[best]), target.hit - int(blocks.noted[best]))",
            "int(passes[best]), target.hit - int(blocks.noted[best]) - 1)",
        ),
        (
            "sampling: a way counts passes from the call's beginning",
            "passes = blocks.passes - earlier",
            "passes = blocks.passes",
        ),
        (
            "sampling: a long way is taken",
            "or int(costs.min()) >= direct:",
            "or int(costs.min()) <= 0:",
        ),
    ),
    *_of(
        "injector/block_profile/counted_call.py",
        "tests/injector/block_profile/test_counted_call.py",
        (
            "sampling: the second stop at an address is counted from the call's beginning",
            "after = left[0] - hit if left else 0",
            "after = left[0] if left else 0",
        ),
    ),
    *_of(
        "injector/kernel_study/checkpoints.py",
        "tests/injector/kernel_study/test_checkpoints.py",
        (
            "study: where the call begins is no pass",
            "way.hit - (way.address == stood_at)",
            "way.hit",
        ),
        (
            "study: a way takes where it begins for a pass",
            "stood_at = 0\n",
            "stood_at = way.address\n",
        ),
        (
            "study: repetitions are passes",
            'instruction.text.startswith("rep") or not instruction.steppable',
            "not instruction.steppable",
        ),
    ),
    *_of(
        "injector/faults/call_profile.py",
        "tests/injector/kernel_study/test_study.py",
        (
            "study: what cannot be struck is drawn",
            "return self.counts.only(self.is_eligible)",
            "return self.counts",
        ),
    ),
    *_of(
        "injector/kernel_study/study.py",
        "tests/injector/kernel_study/test_study.py",
        (
            "study: a draw depends on what else is drawn",
            "draw = rng.generator(seed, stream, index)",
            "draw = rng.generator(seed, stream, len(points))",
        ),
    ),
    *_of(
        "injector/faults/eligibility.py",
        "tests/injector/faults/test_eligibility.py",
        ("sampling: a system call is struck", "if not instruction.steppable:", "if False:"),
        (
            "sampling: memory is struck where there is none",
            "return bool(eligible_memory(",
            "return True or bool(eligible_memory(",
        ),
        (
            "sampling: any number has a field",
            "if (among := groups(fault, one.width_bits, one.element_bits, one.accessed))",
            "if (among := groups(fault, one.width_bits, 64, one.accessed))",
        ),
    ),
    *_of(
        "injector/faults/eligibility.py",
        "tests/injector/faults/test_eligibility.py",
        (
            "masks: an instruction is corrupted that has too few bits",
            "return bool(groups(fault, 8 * len(instruction.code)))",
            "return True",
        ),
    ),
    *_of(
        "services/models/faults/arithmetic.py",
        "tests/services/models/faults/test_masks.py",
        ("masks: uniform may flip nothing", ".any():", ".any() and False:"),
        ("masks: a word is a byte", '"word": 32', '"word": 8'),
        (
            "masks: of a histogram's keys the first is too likely",
            "edges, draw.random() * edges[-1]",
            "edges, draw.random() ** 1.1 * edges[-1]",
        ),
        ("masks: a position is of the operand's first number", "return bits.start if", "return 0 if"),
        (
            "masks: an operand is struck in which not all fits",
            "len(bits) >= fault.most_bits and _has(bits, named)",
            "_has(bits, named)",
        ),
        ("masks: a position may be missing", "and _has(bits, named)", ""),
    ),
    *_of(
        "services/models/faults/mask_histogram.py",
        "tests/services/models/faults/test_masks.py",
        ("masks: a histogram need not sum to 1", "if table and abs(total - 1) > _ROUNDING:", "if False:"),
        ("masks: the order of a file's lines changes draws", "dict(sorted(table.items()))", "dict(table)"),
    ),
    *_of(
        "sim/sensors/faults.py",
        "tests/sim/sensors/test_faults.py",
        (
            "equipment: a sensor fails for ever",
            "if not fault.from_s * 1e9 <= now_ns < self._until_s * 1e9:",
            "if not fault.from_s * 1e9 <= now_ns:",
        ),
        ("equipment: what is stuck has old stamps", "changed.header = header", "pass"),
        (
            "equipment: a delayed sensor says the newest",
            "self._delayed(now_ns - round((fault.size or 0.0) * 1e9))",
            "self._delayed(now_ns)",
        ),
        (
            "equipment: a slow sensor is not slow",
            "return now_ns - self._last_ns < (fault.size or 0.0) * 1e9",
            "return False",
        ),
        (
            "equipment: a position is off the other way",
            "xyz(pose.position) + np.array([size",
            "xyz(pose.position) - np.array([size",
        ),
    ),
    *_of(
        "sim/vehicle/motor_fault.py",
        "tests/sim/vehicle/test_motor_fault.py",
        (
            "equipment: another motor fails",
            "MOTORS.index(fault.target)",
            "(MOTORS.index(fault.target) + 1) % 4",
        ),
        (
            "equipment: a motor gives more than it can",
            "min(max(self._instead(step, asked_n), 0.0), self._most_n)",
            "self._instead(step, asked_n)",
        ),
        ("equipment: a change is not recorded", "if given_n == asked_n:", "if True:"),
    ),
    *_of(
        "services/system/shared_stats.py",
        "tests/services/system/test_shared_stats.py",
        (
            "statistics: a step after the end counts",
            'if one["step_ns"] >= end_ns]',
            'if one["step_ns"] > end_ns + 10**12]',
        ),
    ),
    *_of(
        "deploy/compose/system/process_tree.py",
        "tests/deploy/compose/system/test_process_tree.py",
        (
            "stack: who is ending is not waited for",
            "found |= _below(found, everybody, spare=[os.getpid()])",
            "pass",
        ),
    ),
    *_of(
        "services/control/pid.py",
        "tests/services/control/test_pid.py",
        ("pid: an error is summed up without a gain", "if tuning.integral != 0.0:", "if True:"),
    ),
    *_of(
        "sim/moving_boxes.py",
        "tests/sim/test_moving.py",
        (
            "moving: an obstacle goes one way only and jumps back",
            "part = 1.0 - abs(2.0 * turn - 1.0)",
            "part = turn",
        ),
        (
            "moving: all begin at the same end",
            "time_s / moving[i, 9] + moving[i, 10]",
            "time_s / moving[i, 9]",
        ),
    ),
    *_of(
        "sim/vehicle/vehicle.py",
        "tests/sim/test_moving.py",
        (
            "moving: contact meets obstacles where they were when the tick began",
            "            self._move_obstacles()\n            mujoco.mj_step(model, data)",
            "            mujoco.mj_step(model, data)",
        ),
        (
            "moving: the camera sees obstacles where the last step began",
            "            mujoco.mj_kinematics(model, data)  # or",
            "            pass  # or",
        ),
    ),
    *_of(
        "sim/mission/qof.py",
        "tests/sim/test_moving.py",
        (
            "moving: clearance is told to obstacles at the beginning",
            "boxes_at(moving, track[k, 0])",
            "boxes_at(moving, 0.0)",
        ),
    ),
    *_of(
        "sim/generators.py",
        "tests/sim/test_generators.py",
        (
            "gates: the clearance is of both sides together",
            "BODY_RADIUS_M + figures.clearance_m",
            "BODY_RADIUS_M + figures.clearance_m / 2",
        ),
        ("forest: trees stand as they fall", "figures.gap_m, count)", "0.0, count)"),
    ),
    *_of(
        "deploy/recording/sensor_messages.py",
        "tests/deploy/recording/test_ros_conventions.py",
        ("tf: the optical frame has the axes of the camera's link", "_HERE, _OPTICAL)", "_HERE, _LEVEL)"),
        (
            "trajectory: times count from the mission's beginning",
            "divmod(round(row[0] * 1e9) - begin_ns, 1_000_000_000)",
            "divmod(round(row[0] * 1e9), 1_000_000_000)",
        ),
    ),
    *_of(
        "services/perception/point_cloud.py",
        "tests/services/perception/test_point_cloud.py",
        ("cloud: what met nothing is a point, too", "misses[missed, 0], ", "points[met, 0], "),
        ("cloud: right is left in the world", "- end[0] * left[axis]", "+ end[0] * left[axis]"),
    ),
    *_of(
        "sim/sensors/telemetry.py",
        "tests/deploy/recording/test_ros_conventions.py",
        (
            "odometry: the twist is in the world frame",
            "linear = rotated(vehicle.velocity, inverse(attitude))",
            "linear = vehicle.velocity",
        ),
        ("odometry: drift is not stated", "_EXACT + _POSITION * drift.variance_m2", "_EXACT"),
    ),
    *_of(
        "sim/autopilot/hil.py",
        "tests/sim/autopilot/test_hil.py",
        (
            "autopilot: the nose points elsewhere",
            "sign * (x + y), sign * (x - y)",
            "sign * (x - y), sign * (x + y)",
        ),
    ),
    *_of(
        "sim/autopilot/hil.py",
        "tests/sim/autopilot/test_hil.py",
        ("autopilot: motors are in our order", "_OURS = (2, 1, 3, 0)", "_OURS = (0, 1, 2, 3)"),
        (
            "autopilot: a rotor's thrust goes with its control",
            "0.0, 1.0) ** 2",
            "0.0, 1.0)",
        ),
    ),
    *_of(
        "deploy/pairing/replay.py",
        "tests/deploy/pairing/test_replay.py",
        ("replay: another struck flag is the same", "& struck == 0", "& struck >= 0"),
    ),
    *_of(
        "deploy/recording/visualization.py",
        "tests/deploy/recording/test_visualization.py",
        (
            "moving obstacles are drawn at their beginning",
            "self._moving.moved(at_ns / 1e9)",
            "self._moving.moved(0.0)",
        ),
    ),
    *_of(
        "services/runtime/node.py",
        "tests/deploy/mission/test_source_level.py",
        (
            "recurrence: a message that a detector may see is struck twice",
            "or message is self._corrupted:",
            "or False:",
        ),
    ),
    *_of(
        "injector/recurrence/schedule.py",
        "tests/injector/recurrence/test_schedule.py",
        (
            "recurrence: an execution is struck by what would come in two",
            "-math.expm1(-expected / executions)",
            "-math.expm1(-2 * expected / executions)",
        ),
        (
            "recurrence: each call is struck alike",
            'rng.generator(seed, f"executions {fault.target}", fault.seed, invocation)',
            'rng.generator(seed, f"executions {fault.target}", fault.seed)',
        ),
    ),
    *_of(
        "injector/recurrence/strike_code.py",
        "tests/injector/recurrence/test_struck_calls.py",
        (
            "recurrence: a strike changes the flags",
            "out.put(_POP_FLAGS)",
            'out.put(bytes.fromhex("488d642408"))',
        ),
        (
            "recurrence: strikes by code are not counted",
            "out.beside(_INCREMENT, words.strikes)",
            "pass",
        ),
    ),
    *_of(
        "injector/recurrence/unwinding.py",
        "tests/injector/recurrence/test_struck_calls.py",
        (
            "recurrence: no exception finds its way",
            "        _replace_returns(tid, process, returns)\n",
            "",
        ),
    ),
    *_of(
        "injector/recurrence/struck_code.py",
        "tests/injector/recurrence/test_struck_calls.py",
        (
            "recurrence: a copy counts in its node's memory",
            "(process or self._process).read_memory(word, _WORD.size)",
            "self._process.read_memory(word, _WORD.size)",
        ),
    ),
    *_of(
        "services/models/outcome.py",
        "tests/services/models/test_outcome.py",
        (
            "recurrence: of the strikes of a call one counts",
            "strikes + max(record.strikes, 1)",
            "strikes + 1",
        ),
    ),
    *_of(
        "injector/strikes/state.py",
        "tests/injector/strikes/test_state.py",
        ("strikes: memory does not tell", "        if first != second:\n", "        if False:\n"),
        (
            "strikes: registers do not tell",
            "same = (one.registers, one.extents) == (other.registers, other.extents)",
            "same = True",
        ),
        (
            "strikes: memory below the stack tells",
            "            begin = min(max(limit - page, 0), _PAGE)\n",
            "            begin = 0\n",
        ),
        (
            "strikes: what is written does not tell",
            'told.update(page.to_bytes(8, "little") + begin.to_bytes(8, "little") + first)',
            'told.update(page.to_bytes(8, "little"))',
        ),
    ),
    *_of(
        "injector/strikes/recorded_bus.py",
        "tests/injector/strikes/test_recorded_bus.py",
        (
            "recorded bus: a message's time does not matter",
            "(recorded[number].ready_ns, recorded[number].payload) == (ready_ns, payload)",
            "recorded[number].payload == payload",
        ),
        (
            "recorded bus: who is silent has sent all",
            "            if sent < len(self._messages[topic]):\n",
            "            if False:\n",
        ),
        (
            "recorded bus: the detector finds whatever it is asked sound",
            "elif number >= len(self.questions) or question != self.questions[number]:",
            "elif number >= len(self.questions):",
        ),
        (
            "recorded bus: copies share what they have taken",
            "twin._inlets = [replace(one) for one in self._inlets]",
            "twin._inlets = self._inlets",
        ),
    ),
    *_of(
        "deploy/pairing/proofs.py",
        "tests/deploy/pairing/test_proofs.py",
        (
            "proofs: a node that strayed proves the twin's outcome",
            'found.result == "same_messages" and _counted',
            'found.result == "strayed" or _counted',
        ),
        (
            "proofs: who died of another signal is said to have died of that of the flight",
            "[found.cause, *struck.causes[1:]]",
            "struck.causes",
        ),
    ),
    *_of(
        "services/runtime/bus_listener.py",
        "tests/services/runtime/test_bus_listener.py",
        (
            "promises: who has no use for the message misses the promise",
            "if carrier is not None and carrier not in self.inlets:",
            "if False:",
        ),
    ),
    *_of(
        "injector/reproducible/launch.py",
        "tests/injector/reproducible/test_launch.py",
        (
            "compiled code: a change of sources meanwhile keeps all others waiting",
            "            compiled_code.is_unfinished()\n            or (not",
            "            not _is_open(_SECOND)\n            and (not",
        ),
    ),
    *_of(
        "dashboard/campaigns/executors/dask.py",
        "tests/dashboard/campaigns/executors/test_dask.py",
        (
            "dask: the client's list of workers is believed",
            "self._client.sync(scheduler.identity, n_workers=-1)",
            "self._client.scheduler_info(n_workers=-1)",
        ),
    ),
    *_of(
        "deploy/config/link_security.py",
        "tests/deploy/config/test_link_security.py",
        ("link: who connects proves nothing", '"enable_mtls": True', '"enable_mtls": False'),
        ("link: any machine may answer", '"verify_name_on_connect": True', '"verify_name_on_connect": False'),
        ("link: viewers do all", '"subjects": ["local", "host"]', '"subjects": ["local", "host", "viewer"]'),
    ),
    *_of(
        "injector/node.py",
        "tests/injector/test_node.py",
        ("injector: a pid of another host is one of ours", "if one.boot_id == target.boot_id and ", "if "),
    ),
    *_of(
        "detector/schemes/physical.py",
        "tests/detector/schemes/test_physical.py",
        (
            "physical: a drift does not add up",
            "sums[at] = max(0.0, sums[at] + sign * z - _SLACK)",
            "sums[at] = max(0.0, sign * z - _SLACK)",
        ),
        (
            "physical: an innovation of one tick is no alarm",
            "max(score, square / numbers[_SQUARE_LIMIT])",
            "score",
        ),
    ),
    *_of(
        "detector/schemes/predictor.py",
        "tests/detector/schemes/test_predictor.py",
        (
            "predictor: one flight more than promised may have an alarm",
            "rank = math.ceil((flights + 1) * (1.0 - RATE))",
            "rank = math.ceil((flights + 1) * (1.0 - RATE)) - 1",
        ),
        (
            "predictor: what was alarmed is the predecessor of the next",
            "        return found\n    if accept:",
            "        remember(memory, values)\n        return found\n    if accept:",
        ),
    ),
    *_of(
        "detector/evaluation/outside_schemes.py",
        "tests/detector/evaluation/test_outside_schemes.py",
        (
            "league: a program is not told that a check has no predecessor",
            "self._fresh.discard(stage)",
            "pass",
        ),
        ("league: half of an answer counts", 'line if line.endswith(b"\\n") else b""', "line"),
    ),
    *_of(
        "services/planning/node.py",
        "tests/deploy/mission/test_reexecution.py",
        (
            "reexecution: what a pilot flies first is judged by nobody",
            'node.put("trajectory", hover)',
            'node.put("trajectory", opened(node, opening))',
        ),
    ),
    *_of(
        "services/recovery/reexecution.py",
        "tests/services/recovery/test_reexecution.py",
        (
            "reexecution: what is told beside is not compared",
            "with self._stage.overheard(heard, in_a_copy=in_a_copy):",
            "with self._stage.overheard(hashlib.blake2b(), in_a_copy=in_a_copy):",
        ),
        (
            "reexecution: no copy is made",
            "self._seen[:] = self._make(make, sent, in_a_copy=True)[1]",
            "os._exit(0)",
        ),
    ),
    *_of(
        "services/recovery/recovery.py",
        "tests/services/recovery/test_reexecution.py",
        (
            "reexecution: the second run takes no time",
            "self._stage.now_ns += self._reexecution.took_ns",
            "pass",
        ),
    ),
    *_of(
        "services/recovery/reexecution.py",
        "tests/services/recovery/test_reexecution.py",
        (
            "reexecution: a strike without a copy is silent",
            "if self._stage.fault_reach.strikes != strikes:",
            "if self._stage.fault_reach.strikes < strikes:",
        ),
        (
            "reexecution: a copy is always made",
            "if not self._stage.fault_reach.covers_next(self._stage.now_ns):",
            "if False:",
        ),
    ),
    *_of(
        "services/runtime/kernel_timer.py",
        "tests/services/runtime/test_kernel_timer.py",
        (
            "reexecution: no copy of the very call that is struck",
            'calls <= page["armed_invocation"]',
            'calls < page["armed_invocation"]',
        ),
        (
            "reexecution: a fault that recurs may always strike",
            "and now_ns < self._marked.until_ns",
            "",
        ),
    ),
    *_of(
        "services/runtime/source_fault.py",
        "tests/services/runtime/test_source_fault.py",
        ("reexecution: no copy for a fault that waits", "in (None, number)", "in (number,)"),
        ("reexecution: copies after the strike", "if self._done or trigger is None:", "if trigger is None:"),
    ),
    *_of(
        "services/recovery/recovery.py",
        "tests/services/recovery/test_recovery.py",
        (
            "fallback: one of a stage that does not recover",
            "if spec is not None and self._recovers:",
            "if spec is not None:",
        ),
        (
            "fallback: the last good output is the first",
            "                self._accepted[topic] = made\n                return made, sent",
            "                self._accepted.setdefault(topic, made)\n                return made, sent",
        ),
    ),
    *_of(
        "services/control/simple_controller.py",
        "tests/services/control/test_simple_controller.py",
        (
            "fallback: the simple controller is as fast as it likes",
            "min(GAIN_1_S, speed_m_s / max(float(distance), 1e-9))",
            "GAIN_1_S",
        ),
        ("fallback: the simple controller flies to nowhere", "if np.isfinite(distance):", "if True:"),
    ),
    *_of(
        "services/planning/trail.py",
        "tests/services/planning/test_trail.py",
        ("fallback: the trail is flown from its beginning", "in reversed(self._places)", "in self._places"),
        ("fallback: the trail has no end", "if step_m > left_m:", "if False:"),
    ),
    *_of(
        "deploy/mission/judgement.py",
        "tests/deploy/mission/test_recovery_report.py",
        ("recovery: false alarms count", "if one.true and one.action", "if one.action"),
        (
            "recovery: the offset is that of the beginning",
            "path.position[[max(int(begun), 0), -1]]",
            "path.position[[0, -1]]",
        ),
    ),
    *_of(
        "services/runtime/node.py",
        "tests/deploy/mission/test_reexecution.py",
        ("reexecution: the copy is struck too", "            self._source_fault = None\n", ""),
    ),
    *_of(
        "deploy/mission/silence.py",
        "tests/deploy/mission/test_silence.py",
        ("silence: who waits for a copy stands still", "(*pids, *copies)", "pids"),
    ),
    *_of(
        "detector/evaluation/coverage.py",
        "tests/detector/evaluation/test_coverage.py",
        (
            "coverage: an alarm after the harm is in time",
            "and self.alarm_s < self.harm.harmed_at_s",
            "",
        ),
        (
            "coverage: an alarm before the fault counts",
            "(self.scores > limit) & (self.times_s >= begin)",
            "self.scores > limit",
        ),
        (
            "coverage: the flights that set the limit tell the false alarms",
            "golden[::2], golden[1::2]",
            "golden[::2], golden[::2]",
        ),
        (
            "coverage: the limit keeps the budget in half of all cases",
            "exceeding -= bool(law.cdf(exceeding) > RISK)",
            "exceeding = round(law.mean())",
        ),
        ("coverage: the tail is forgotten", "(top / expected) ** index", "1.0"),
    ),
    *_of(
        "injector/program/launcher.py",
        "tests/injector/program/test_approach.py",
        (
            "program: threads go to the processors that they ask for",
            "_SETAFFINITY = 0xC000003E, 318, 203",
            "_SETAFFINITY = 0xC000003E, 318, 204",
        ),
    ),
    *_of(
        "injector/program/approach.py",
        "tests/injector/program/test_approach.py",
        (
            "program: the countdown ends a pass early",
            "memory, point.counted_at, point.hit, point.by_way_of",
            "memory, point.counted_at, point.hit - 1, point.by_way_of",
        ),
    ),
    *_of(
        "injector/program/profile.py",
        "tests/injector/program/test_approach.py",
        (
            "program: passes are counted where others pass, too",
            "if self._passes[one] != self._passes[address]:",
            "if self._passes[one] > self._passes[address]:",
        ),
    ),
    *_of(
        "injector/program/profile.py",
        "tests/injector/program/test_approach.py",
        (
            "program: a jump lies in code that the run executes",
            "start <= at < end and at not in self._executed",
            "start <= at < end",
        ),
    ),
    *_of(
        "injector/faults/eligibility.py",
        "tests/injector/program/test_flips.py",
        (
            "program: other registers are struck than those that are named",
            "for one in map(named, fault.registers) if one is not None",
            "for one in map(named, fault.registers[:1] and ['rax']) if one is not None",
        ),
    ),
    *_of(
        "injector/program/countdown.py",
        "tests/injector/program/test_approach.py",
        (
            "program: a jump is put where others arrive",
            "if any(at in arrivals for at in range(address + 1, end)):",
            "if any(at in arrivals for at in range(address + 1, address + 1)):",
        ),
    ),
    *_of(
        "dashboard/evidence/counts.py",
        "tests/dashboard/evidence/test_counts.py",
        (
            "evidence: cells of several arms are taken together",
            "    if len(cells) > 1:",
            "    if len(cells) > 99:",
        ),
        (
            "evidence: a fault that struck nothing counts as benign",
            'elif run.result.injection != "injected":',
            "elif not run.result.injection:",
        ),
        (
            "evidence: harm that no message shows has not manifested",
            "sum(one.manifested or bool(one.result.harm) for one in self.strikes)",
            "sum(one.manifested for one in self.strikes)",
        ),
    ),
    *_of(
        "dashboard/evidence/ledger.py",
        "tests/dashboard/evidence/test_ledger.py",
        (
            "evidence: the bound is that of no strike less",
            "generator.beta(found + 1, of - found, draws)",
            "generator.beta(found + 0.5, of - found + 0.5, draws)",
        ),
    ),
    *_of(
        "dashboard/design/paired_strikes.py",
        "tests/dashboard/design/test_paired_strikes.py",
        (
            "design: harm that one protection averts is there beside another",
            "np.where(bare == 1, (beside == 1).all(axis=0), (beside == 1).any(axis=0))",
            "(beside == 1).any(axis=0)",
        ),
        (
            "design: strikes are paired by number alone",
            "return run.cell.world, run.number, run.seed",
            "return run.cell.world, run.number, 0",
        ),
    ),
    *_of(
        "dashboard/design/designs.py",
        "tests/dashboard/design/test_designs.py",
        (
            "design: what is on for one element is not on for the others",
            "strikes.counts(choice.protections)",
            "strikes.counts([name for name in choice.protections if name in choice.options[:1]])",
        ),
        (
            "design: the front has designs that are the same as others",
            "if not (axes <= own).all(axis=1).any():",
            "if not (axes < own).all(axis=1).any():",
        ),
        (
            "design: nothing is left out as another option beats it",
            "        if _size(options) > limit:\n            for number",
            "        if _size(options) > limit + 10**9:\n            for number",
        ),
    ),
    *_of(
        "dashboard/design/prediction.py",
        "tests/dashboard/design/test_prediction.py",
        (
            "design: a prediction takes what was seen for what is true",
            "scipy.stats.betabinom.pmf(np.arange(more + 1), more, first, second)",
            "scipy.stats.binom.pmf(np.arange(more + 1), more, first / (first + second))",
        ),
    ),
    *_of(
        "dashboard/design/second_computer.py",
        "tests/dashboard/design/test_second_computer.py",
        (
            "design: DMR masks a fault that stays",
            'if name == "TMR" or fault.recurrence == "once"]',
            "]",
        ),
    ),
    *_of(
        "dashboard/design/specification.py",
        "tests/dashboard/design/test_specification.py",
        (
            "design: the faults that a prediction was made of are flown again",
            '"seed": one.fault.seed + most',
            '"seed": one.fault.seed',
        ),
    ),
    *_of(
        "dashboard/design/overheads.py",
        "tests/dashboard/design/test_overheads.py",
        (
            "design: golden flights that a protection loses are not told",
            "lost = len(arrived) - len(kept)",
            "lost = 0",
        ),
    ),
    *_of(
        "injector/program/counted_program.py",
        "tests/injector/program/test_counted_program.py",
        (
            "program: a second signal has the first one delivered amid our own instructions",
            "                    came.append(report.signal)\n        return came",
            "                    came.append(report.signal)\n                    break\n        return came",
        ),
        (
            "program: a signal that comes while another one is delivered is lost",
            "            ptrace.send(thread.pid, thread.tid, number)",
            "            pass",
        ),
    ),
    *_of(
        "injector/program/translator.py",
        "tests/injector/program/test_counted_program.py",
        (
            "program: return addresses are those of translations",
            "            self._push(one.next_ip)\n            self.way_out(JUMP, one.near_branch_target)",
            "            self._push(self.at)\n            self.way_out(JUMP, one.near_branch_target)",
        ),
        (
            "program: counting spoils the overflow flag",
            "self.code += _OVERFLOW_FROM_AL + _FLAGS_FROM_AH + _RAX_BACK",
            "self.code += _FLAGS_FROM_AH + _RAX_BACK",
        ),
    ),
    *_of(
        "injector/reproducible/read_only_files.py",
        "tests/injector/program/test_launched_program.py",
        (
            "program: a fault may have it remove files of the user",
            '_set_attributes(b"/", _AT_RECURSIVE, _ATTRIBUTES.pack(_READ_ONLY, 0, 0, 0))',
            "pass",
        ),
    ),
    *_of(
        "injector/program/launched_program.py",
        "tests/injector/program/test_launched_program.py",
        ("program: the stack lies by the environment", "-size % STACK_STRINGS", "-size % 1"),
        (
            "program: random bytes are drawn by the kernel",
            "            self.give_random_bytes(thread)\n        super",
            "            pass\n        super",
        ),
    ),
    *_of(
        "injector/program/watch.py",
        "tests/injector/program/test_program_injector.py",
        (
            "program: who is killed by another process has crashed",
            "if sender is not None and self._program.is_outside(sender):",
            "if sender is not None and not self._program.is_outside(sender):",
        ),
        (
            "program: a run that reports again and again is never looked at",
            "if time.monotonic() >= self._look_at_s:",
            "if told is None:",
        ),
    ),
    *_of(
        "injector/program/program_injector.py",
        "tests/injector/program/test_program_injector.py",
        (
            "program: an exit status that tells of an error is silent corruption",
            "if ending.status in self._runs.spec.detected:",
            "if ending.status in ():",
        ),
    ),
    *_of(
        "injector/program/comparison.py",
        "tests/injector/program/test_comparison.py",
        (
            "program: a deviation is that of the first number",
            "    return max(apart, default=0.0)",
            "    return next(apart, 0.0)",
        ),
    ),
    *_of(
        "injector/tracing/source_lines.py",
        "tests/injector/tracing/test_source_lines.py",
        (
            "source lines: debug information of another program is taken",
            "if one is not None and zlib.crc32(one) == checksum:",
            "if one is not None:",
        ),
        (
            "source lines: of two files that end so one is taken",
            "    if len(paths) > 1:\n",
            "    if False:\n",
        ),
    ),
    *_of(
        "injector/tracing/line_tables.py",
        "tests/injector/tracing/test_source_lines.py",
        (
            "source lines: code counts that the linker has left out",
            "if any(begin <= rows[0][0] < end for begin, end in self._code)",
            "if True",
        ),
        (
            "source lines: units are found by the table alone that Clang does not write",
            "for ranges in (self._told, self._untold):",
            "for ranges in (self._told,):",
        ),
    ),
]
