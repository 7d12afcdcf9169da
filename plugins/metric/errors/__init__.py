"""Mean absolute and root mean square errors of reals."""
