"""Function that runs the command line of a module other than `framework`, and prints errors as sentences."""

import sys
from collections.abc import Callable

from framework.errors import UserError
from framework.storage.closed_pipes import survive_closed_pipes
from framework.storage.files import describe_unwritable
from framework.storage.working_directory import refuse_settings


def run_command(main: Callable[[list[str]], object]) -> None:
    """Call `main` with the arguments of this process.

    The process exits with 0 (success), 1 (the command was refused or failed) or 130 (interrupted); argparse exits with
    2 if the arguments are wrong. If the reader of the output ends, as in `... | head -1`, the rest of the output is
    dropped and the command continues.
    """
    survive_closed_pipes()
    try:
        refuse_settings(("numba", "matplotlib"))
        main(sys.argv[1:])
    except UserError as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.stderr.write("error: interrupted.\n")
        sys.exit(130)
    except OSError as error:
        refused = describe_unwritable(error)
        if refused is None and error.filename is None:
            raise
        sys.exit(
            f"error: {refused or f'{error.filename} cannot be written ({error.strerror}). Choose another path.'}"
        )
