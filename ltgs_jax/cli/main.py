"""The entry point: parse, run, and turn what goes wrong into one line and an exit status."""

import os
import sys
import traceback
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from .arguments import UsageError, parse

DONE, FAILED, WRONG_INPUT, INTERRUPTED = 0, 1, 2, 130


def entry() -> None:
    """The process `ltgs`. Interrupted, it ends at once: threads that still compile would crash with the interpreter."""
    status = main()
    sys.stdout.flush()
    sys.stderr.flush()
    if status == INTERRUPTED:
        os._exit(status)
    sys.exit(status)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command that `argv` (the process's own arguments unless given) names; returns the exit status.

    0 done; 2 the input or an option is wrong, one line on stderr; 130 interrupted; 1 anything else.
    """
    keep_compiled_code()
    compile_quickly()
    try:
        options = parse(sys.argv[1:] if argv is None else argv)
    except SystemExit as stop:
        return int(stop.code or 0)
    except UsageError as error:
        return _say(str(error), WRONG_INPUT)
    from ltgs_jax.io import InputError

    from .commands import run

    try:
        run(options)
    except InputError as error:
        return _say(str(error), WRONG_INPUT)
    except KeyboardInterrupt:
        return _say("interrupted; the same command again goes on from the last finished stage", INTERRUPTED)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # else the interpreter complains at its end
        return FAILED
    except ImportError as error:
        return _say(f"{error}; `pip install 'ltgs-jax[demo,view]'` brings the optional packages", FAILED)
    except OSError as error:
        return _say(str(error), FAILED)
    except Exception:
        traceback.print_exc()
        return _say("this is a fault of ltgs, not of your input; what finished stages wrote is kept", FAILED)
    return DONE


def keep_compiled_code() -> None:
    """Let jax keep compiled programs between runs, in `$LTGS_CACHE` or the user's cache folder.

    `LTGS_CACHE=off` keeps none; jax's own variable JAX_COMPILATION_CACHE_DIR goes before both. Has no effect once jax
    is imported.
    """
    choice = os.environ.get("LTGS_CACHE", "")
    if choice.lower() in ("off", "0", "none") or "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    folder = Path(choice) if choice else Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache") / "ltgs_jax"
    try:
        folder = folder.expanduser()
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):
        return  # no home to write to: compile each time
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")


def compile_quickly() -> None:
    """Have XLA compile for the CPU by its older emitters: a third less time to compile, a tenth more to run.

    Set by name, and only for the release that was measured, since XLA ends a process over a name that it does not know.
    Has no effect once jax has looked for its devices.
    """
    flag = "--xla_cpu_use_fusion_emitters"
    flags = os.environ.get("XLA_FLAGS", "")
    if flag not in flags and version("jaxlib").startswith("0.10."):
        os.environ["XLA_FLAGS"] = f"{flags} {flag}=false".strip()


def _say(message: str, status: int) -> int:
    print(f"ltgs: {' '.join(message.split())}", file=sys.stderr)
    return status
