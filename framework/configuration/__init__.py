"""From names to built parts: registry, schema, settings, composition, assembly."""
