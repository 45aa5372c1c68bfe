"""Runs commands of wheretolook without what only Linux or POSIX has: ELSEWHERE.py '[["select", "--map", …], …]'.

Other packages keep the modules and files by which they do on Linux what they do otherwise elsewhere; functions and
signals are removed for all. Worker processes run this file, too, before they import wheretolook.
"""

import builtins
import errno
import json
import os
import signal
import subprocess  # noqa: F401  (it takes another module for Windows)
import sys
from types import ModuleType

POSIX_ONLY = ["fcntl", "resource", "termios", "pwd", "grp", "pty"]
KEEP = {"SIGINT", "SIGTERM", "SIGABRT", "SIGFPE", "SIGILL", "SIGSEGV"}  # which Windows has
OF_SIGNALS = ["alarm", "setitimer", "getitimer", "ITIMER_REAL", "pthread_kill", "pthread_sigmask", "sigwait", "SIG_BLOCK", "SIG_UNBLOCK"]  # fmt: skip
OF_OS = ["sched_getaffinity", "sched_setaffinity", "pread", "pwrite", "O_NOFOLLOW"]
if sys.version_info < (3, 13):
    OF_OS.append("O_NONBLOCK")  # which shutil needs on POSIX since

msvcrt = ModuleType("msvcrt")
msvcrt.LK_NBLCK = 2
original_import = builtins.__import__


def locking(file, mode, n_bytes):
    """Lock bytes from the current position as Windows does, here by lockf(3)."""
    try:
        os.lockf(file, os.F_TLOCK, n_bytes)
    except BlockingIOError as error:
        raise PermissionError(errno.EACCES, "Permission denied") from error


def import_elsewhere(name, globals=None, locals=None, fromlist=(), level=0):
    if str((globals or {}).get("__name__")).partition(".")[0].startswith("wheretolook"):
        if name in POSIX_ONLY:
            raise ModuleNotFoundError(f"No module named '{name}'", name=name)
        if name == "msvcrt":
            return msvcrt
    return original_import(name, globals, locals, fromlist, level)


def without_proc(event, given):
    if event in ("open", "os.listdir", "os.scandir") and str(given[0]).startswith("/proc"):
        frame = sys._getframe(1)
        while frame is not None:
            if frame.f_globals.get("__name__", "").partition(".")[0] == "psutil":
                return
            frame = frame.f_back
        raise FileNotFoundError(errno.ENOENT, "No such file or directory", given[0])


def leave_posix():
    msvcrt.locking = locking
    builtins.__import__ = import_elsewhere
    for name in [name for name in dir(signal) if name.startswith("SIG") and name[3:4] != "_" and name not in KEEP]:
        delattr(signal, name)
    for name in OF_SIGNALS:
        delattr(signal, name)
    for name in OF_OS:
        delattr(os, name)
    signal.valid_signals = lambda: {getattr(signal, name) for name in KEEP}
    sys.addaudithook(without_proc)


leave_posix()

if __name__ == "__main__":
    from fixed_fields import main

    for command in json.loads(sys.argv[1]):
        if command[0] == "train":
            from lightning.pytorch.trainer.connectors import signal_connector

            signal_connector._IS_WINDOWS = True  # or Lightning uses SIGKILL
        if main(command):
            sys.exit(f"failed: {command}")
