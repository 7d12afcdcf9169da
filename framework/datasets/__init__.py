"""Code that several data sets share: data in memory, images, tables, MATLAB files, folders of scans."""
