"""report.html: pictures, tables, plots, settings and commands of a comparison, in one page without network."""
