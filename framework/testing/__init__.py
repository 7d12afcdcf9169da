"""Contract tests of the registries: the rows of a plugin decide which checks run, in pytest and in `mode=check`.

`contract` runs the checks of a plugin that is given by name. `rows` defines what a plugin states about itself, and
`finding` defines the result of a check. Each group of plugins has its own module of checks; `densities` holds what
every density must satisfy.
"""
