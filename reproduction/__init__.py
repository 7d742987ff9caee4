"""Compare the paper's printed numbers with ours (`acquire paper`).

Each group of numbers has a module of its own; `whole.compare_paper` computes all of them and
`page.write_page` shows them.
"""
