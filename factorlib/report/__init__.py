"""The report of a run: one self-contained page with pictures beside the photos, errors beside nulls, and costs."""
