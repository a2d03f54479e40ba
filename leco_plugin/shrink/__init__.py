"""`leco shrink`: the smallest gate that decides as a frozen one does."""
