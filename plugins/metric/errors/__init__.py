"""Mean absolute and root mean square errors of real-valued targets."""
