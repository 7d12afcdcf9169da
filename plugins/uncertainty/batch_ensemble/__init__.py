"""BatchEnsemble: members that share their weights up to a factor for each input and output of a layer."""
