"""What the functions of `acquire` return: small frozen objects to print, tabulate and plot."""
