"""The cell cache: a frozen gate's decisions on cells, built once and asked before the gate."""
