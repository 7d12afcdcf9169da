"""Contract tests of the registries: checks of every installed plugin, run by pytest and by `mode=check`.

A plugin lists in its `rows.py` with which parameters it is checked, as the classes in `rows` describe. `contract` runs
the checks of a plugin by name, and `finding` defines the result of a check. Each registry has its own module of checks;
`densities` checks the densities of density heads and uncertainty wrappers.
"""
