"""Choice of the process that writes files and prints if several processes train together."""

import os


def first_rank() -> bool:
    """Return whether this process writes the files of the run: it trains alone, or it has rank 0.

    A launcher (Lightning, torchrun, srun) sets the rank and the number of ranks in environment variables. If only the
    rank is set, another program has set it, and it is ignored.
    """
    for rank, ranks in (("RANK", "WORLD_SIZE"), ("SLURM_PROCID", "SLURM_NTASKS")):
        if rank in os.environ and os.environ.get(ranks, "1") != "1":
            return os.environ[rank] == "0"
    return os.environ.get("LOCAL_RANK", "0") == "0" and os.environ.get("NODE_RANK", "0") == "0"
