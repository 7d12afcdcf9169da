"""Which of the processes that train together writes files and speaks."""

import os


def first_rank() -> bool:
    """Whether this process keeps the run's record: the only one, or the first of several that train together.

    A launcher (Lightning, torchrun, srun) says which rank this is and of how many. A rank without a number of ranks is
    somebody else's variable.
    """
    for rank, ranks in (("RANK", "WORLD_SIZE"), ("SLURM_PROCID", "SLURM_NTASKS")):
        if rank in os.environ and os.environ.get(ranks, "1") != "1":
            return os.environ[rank] == "0"
    return os.environ.get("LOCAL_RANK", "0") == "0" and os.environ.get("NODE_RANK", "0") == "0"
