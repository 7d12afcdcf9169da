"""People rendered by neural pixels (SMPLpix): vertices on the pixels they fall on, networks that fill the rest."""
