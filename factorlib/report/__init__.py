"""One self-contained page about a run: pictures beside the photos, numbers beside their nulls, and what it cost."""
