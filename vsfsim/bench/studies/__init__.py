"""Studies: the papers' tables that compare training sets, settings, views and objects, as data and as results."""
