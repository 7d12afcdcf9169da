"""The contracts of the registries as checks: a plugin's rows buy every one of them, in pytest and in `mode=check`.

`contract` runs them for a plugin by name; `rows` is what a plugin states; `finding` what a check says. The checks
themselves are in one module for each group, and `densities` holds what any density must satisfy.
"""
