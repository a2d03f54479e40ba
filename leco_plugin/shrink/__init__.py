"""`leco shrink`: the smallest gate that decides as a frozen one does, at a price that is measured."""
