"""Runs recorded launches one after another without Python, on several threads that meet between them.

A program is a list of phases, each of which is one launch or several ranges of rows of one. All threads go through all
phases: a thread takes ranges of a phase until none is left, and goes on when all of them are done. So it does not
matter how many threads there are, nor when one of them comes; one that comes late passes phases that are done.

    board      the program that runs now, how many threads are inside, and whether each helper is awake
    counters   of each phase: how many ranges were taken, and how many are done

Helpers are threads of `threads.py` that look at the board. One that has found nothing for `PATIENCE` looks sleeps, and
is woken by Python when the next program begins: waking takes longer than most launches. Which thread runs a range makes
no difference to its result.
"""

from __future__ import annotations

import ctypes
import os
import threading
from collections.abc import Sequence

import numpy as np
import warp as wp

from warpgarment.kernels import compiling, recorded, threads

wp.set_module_options(compiling.options())

PATIENCE = 8192
"""Looks at the board before a helper sleeps: 50 to 300 microseconds, which depends on the processor."""
LINE = 8  # numbers of a cache line, which threads that write to different ones do not share
PROGRAM, INSIDE, YIELD, HELPERS = (LINE * k for k in range(4))  # places on the board

_WALK = """
#if !defined(__CUDACC__)
    typedef long long number;
    typedef void (*launch_function)(void*, void*);
    typedef void (*yield_function)(void);
    struct Team {
        static void pause(number* board, number looks) {
#if defined(__x86_64__)
            __builtin_ia32_pause();
#elif defined(__aarch64__)
            __builtin_arm_yield();
#endif
            if (looks % 4096 == 0 && board[YIELD]) ((yield_function)board[YIELD])();
        }
        static number read(number* at) { return __atomic_load_n(at, __ATOMIC_SEQ_CST); }
        static void walk(number* board, number* program) {
            const number phases = program[0];
            number* counters = (number*)program[1];
            const number *first = program + 2, *calls = first + phases + 1;
            for (number p = 0; p < phases; p++, counters += 16) {
                const number count = first[p + 1] - first[p];
                for (;;) {
                    const number r = __atomic_fetch_add(counters, 1, __ATOMIC_SEQ_CST);
                    if (r >= count) break;
                    const number* call = calls + 3 * (first[p] + r);
                    ((launch_function)call[0])((void*)call[1], (void*)call[2]);
                    __atomic_fetch_add(counters + 8, 1, __ATOMIC_SEQ_CST);
                }
                for (number looks = 1; read(counters + 8) < count; looks++) pause(board, looks);
            }
        }
    };
"""


def _native(body: str) -> str:
    text = _WALK + body + "\n#endif\n"
    for name in ("PROGRAM", "INSIDE", "YIELD"):
        text = text.replace(name, str(globals()[name]))
    return text


@wp.func_native(
    _native("""
    number *b = (number*)board, *p = (number*)program, *counters = (number*)p[1];
    for (number i = 0; i < 16 * p[0]; i++) counters[i] = 0;
    if (alone) {
        Team::walk(b, p);
        return;
    }
    __atomic_store_n(b + PROGRAM, (number)p, __ATOMIC_SEQ_CST);
    Team::walk(b, p);
    __atomic_store_n(b + PROGRAM, 0, __ATOMIC_SEQ_CST);
    for (number looks = 1; Team::read(b + INSIDE); looks++) Team::pause(b, looks);
""")
)
def lead(board: wp.uint64, program: wp.uint64, alone: int): ...


@wp.func_native(
    _native("""
    number *b = (number*)board, *awake = (number*)state;
    for (;;) {
        for (number looks = 1; !Team::read(b + PROGRAM) && looks < patience; looks++) Team::pause(b, looks);
        if (!Team::read(b + PROGRAM)) {
            number one = 1, none = 0;
            __atomic_store_n(awake, 0, __ATOMIC_SEQ_CST);
            if (!Team::read(b + PROGRAM)) return;
            if (!__atomic_compare_exchange_n(awake, &none, one, false, __ATOMIC_SEQ_CST, __ATOMIC_SEQ_CST)) return;
        }
        __atomic_fetch_add(b + INSIDE, 1, __ATOMIC_SEQ_CST);
        number* p = (number*)Team::read(b + PROGRAM);
        if (p) Team::walk(b, p);
        __atomic_fetch_add(b + INSIDE, -1, __ATOMIC_SEQ_CST);
    }
""")
)
def follow(board: wp.uint64, state: wp.uint64, patience: int): ...


@wp.kernel(enable_backward=False)
def lead_kernel(board: wp.uint64, program: wp.uint64, alone: wp.int32):
    lead(board, program, alone)


@wp.kernel(enable_backward=False)
def follow_kernel(board: wp.uint64, state: wp.uint64, patience: wp.int32):
    follow(board, state, patience)


class Program:
    """Launches that can be run again and again.

    Args:
        phases: Launches that follow each other; those of a phase are independent of each other.
    """

    def __init__(self, phases: Sequence[Sequence[recorded.Launch]]) -> None:
        self._kept = [list(phase) for phase in phases]
        self.widest = max(map(len, self._kept))
        first = np.cumsum([0, *map(len, self._kept)])
        self._counters = np.zeros(2 * LINE * len(self._kept), np.int64)
        calls = [number for phase in self._kept for launch in phase for number in launch.addresses]
        self._numbers = np.array([len(self._kept), self._counters.ctypes.data, *first, *calls], np.int64)
        cpu = wp.get_device("cpu")
        given = _board.ctypes.data, self._numbers.ctypes.data
        self._led = [recorded.prepared(lead_kernel, 1, [*given, alone], cpu) for alone in (0, 1)]

    def __call__(self) -> None:
        """Runs the launches on `threads.count()` threads, or on this one if others are at it."""
        helpers = min(threads.count(), self.widest) - 1
        if helpers <= 0 or not _leading.acquire(blocking=False):
            self._led[1]()
            return
        try:
            _wake(helpers)
            self._led[0]()
        finally:
            _leading.release()


_MOST_HELPERS = 255
_board = np.zeros(HELPERS + LINE * _MOST_HELPERS, np.int64)
_yielding = getattr(ctypes.CDLL(None), "sched_yield", None) if os.name == "posix" else None
if _yielding is not None:
    _board[YIELD] = ctypes.cast(_yielding, ctypes.c_void_p).value or 0
_leading = threading.Lock()
_followers: list[recorded.Call] = []


def _wake(helpers: int) -> None:
    """Wakes helpers that sleep."""
    helpers = min(helpers, _MOST_HELPERS)
    while len(_followers) < helpers:
        state = _board[HELPERS + LINE * len(_followers) :].ctypes.data
        given = [_board.ctypes.data, state, PATIENCE]
        _followers.append(recorded.prepared(follow_kernel, 1, given, wp.get_device("cpu")))
    for number in range(helpers):
        if not _board[HELPERS + LINE * number]:
            _board[HELPERS + LINE * number] = 1
            threads.give(_followers[number], helpers)


def _forget() -> None:
    """In a forked process, where no helper is left."""
    global _leading
    _leading = threading.Lock()
    _board[PROGRAM] = _board[INSIDE] = 0
    _board[HELPERS:] = 0


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)
