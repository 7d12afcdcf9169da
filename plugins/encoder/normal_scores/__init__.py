"""Normal scores of numbers beside the numbers themselves."""
