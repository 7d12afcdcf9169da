"""Files on this machine: the cache, and what is written whole or not at all."""
