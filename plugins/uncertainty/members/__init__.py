"""Several members, or several passes of one."""
