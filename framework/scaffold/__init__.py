"""Examples of plugins, one for each registry, which `mode=new` copies under another name.

Each folder holds a plugin that passes `mode=check`: `example.py` and, if the check needs parameters or references for
the plugin, `rows.py`. `tests/test_new.py` runs the tests of every copy.
"""
