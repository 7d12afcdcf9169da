"""Configuration: registry, schema, settings, composition, and assembly of the parts."""
