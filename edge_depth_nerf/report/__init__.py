"""report.html: one page that needs no network: pictures, tables, plots, settings and commands of a comparison."""
