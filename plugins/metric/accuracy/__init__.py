"""Share of samples whose most likely class is the true one."""
