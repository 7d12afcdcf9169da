"""Code that data sets of several families share: fields, images, tables, generated files."""
