"""Jobs handed out to workers that may die, until each job is done or proved to kill its worker.

If several jobs run at a time, a broken pool does not tell which of them killed a worker. So a lost job is first run again after
all others. A job that is lost `MOST_LOSSES` times waits until all others are done, and then runs alone; if its worker dies
`MOST_LOSSES` times again, the job is the cause and is given up.
"""

import queue
from collections import Counter, deque
from collections.abc import Callable, Sequence
from typing import Any

from .executors import HANDED_OUT, Workers, is_broken, is_loss, is_proof

MOST_LOSSES = 3
# Time between two checks for a request to stop, while no result arrives, s.
LOOK_EVERY = 0.2


def hand_out(
    jobs: Sequence[int],
    submit: Callable[[int], Any],
    workers: Workers,
    done: Callable[[int, Any], None],
    given_up: Callable[[int], None],
    stop: Callable[[], bool],
) -> None:
    """Run all jobs (numbers): `submit` hands one out and returns its future, `done` gets its result, in any order.

    `given_up` is called for jobs that kill their workers.

    **Raises:** `KeyboardInterrupt` once `stop()` is true, or if a worker was interrupted; `RuntimeError` if there are no
    workers any more; and anything that a job raises.
    """
    waiting, suspects = deque(jobs), deque()
    # How often each job was lost while others ran, and while it ran alone.
    lost, lost_alone = Counter(), Counter()
    under_way: dict[Any, int] = {}  # futures, in the order in which they were handed out
    alone: int | None = None  # the job that runs alone
    back: queue.SimpleQueue[Any] = queue.SimpleQueue()
    try:
        while waiting or suspects or under_way:
            room = HANDED_OUT if workers.side_by_side is None else workers.side_by_side + 1
            chosen = waiting if waiting or under_way else suspects
            while chosen and len(under_way) < (1 if chosen is suspects else room):
                number = chosen[0]
                alone = number if chosen is suspects else None
                try:
                    future = submit(number)
                except Exception as error:
                    if not is_broken(error):
                        raise
                    if not under_way:
                        workers.renew()
                        continue
                    break  # the futures under way will report the same error
                chosen.popleft()
                under_way[future] = number
                future.add_done_callback(back.put)
            try:
                future = back.get(timeout=LOOK_EVERY)
            except queue.Empty:
                future = None
            if stop():
                raise KeyboardInterrupt
            if future is None or future not in under_way:
                continue
            running = list(under_way)[: workers.side_by_side]
            number = under_way.pop(future)
            try:
                result = future.result()
            except BaseException as caught:
                if not is_loss(caught):
                    raise
                error = caught
            else:
                done(number, result)
                workers.progressed()
                continue
            gone = [(future, number)]
            if is_broken(error):
                # Jobs that were finished before the workers died still report their results.
                gone += [one for one in under_way.items() if not _finished(one[0])]
                for one, _ in gone[1:]:
                    del under_way[one]
                workers.renew()
            for one, number in gone:
                # Jobs begin in order, so only the first ones were running.
                blamed = MOST_LOSSES if is_proof(error) else int(one in running)
                if number == alone:
                    lost_alone[number] += blamed
                else:
                    lost[number] += blamed
                if lost_alone[number] >= MOST_LOSSES:
                    given_up(number)
                elif lost[number] >= MOST_LOSSES:
                    suspects.append(number)
                else:
                    waiting.append(number)
    finally:
        workers.take_back(under_way)


def _finished(future) -> bool:
    return future.done() and not future.cancelled() and future.exception() is None
