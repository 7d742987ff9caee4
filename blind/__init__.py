"""The other side: makes sealed cases to check the diagnosis by, with numerics of its own.

Shares nothing with the twin: own elements, own light, own noise, own forms of every effect. It
imports no other package, and `diagnosis` never imports it. What it knows of the reed and of the
bench is what the paper prints, and what `docs/reference/run-file.md` says of run files.
"""
