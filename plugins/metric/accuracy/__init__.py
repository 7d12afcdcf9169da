"""Share of samples whose likeliest class is the true one."""
