"""Files on this machine: atomic writing, the cache, and safe readers for untrusted files."""
