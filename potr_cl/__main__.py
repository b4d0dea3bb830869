"""The program: ``python -m potr_cl`` and the script ``potr-cl``."""

# Few imports: until the first lines of main have run, Ctrl-C ends in a traceback.
import os
import sys
import warnings


def main() -> int:
    """Run the command line as a process of its own.

    Returns:
        Its exit code, see :func:`potr_cl.cli.main`; a process that a signal ends exits with 128 and its number.
    """
    from potr_cl.host.process import end_at_once, end_cleanly_on_signals, open_standard_files

    end_cleanly_on_signals()
    open_standard_files()
    # That a number of a file is beyond single precision, as NumPy remarks, is no news to who runs a command.
    warnings.filterwarnings("ignore", category=RuntimeWarning, append=True)
    # NumPy's library for matrices starts a thread a processor, which wait for work at full speed. There is little of it
    # here, and others need the processors.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

    from potr_cl.cli import main as run

    code = run()
    end_at_once(code)
    return code


if __name__ == "__main__":
    sys.exit(main())
