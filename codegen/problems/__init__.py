"""Control problems: one module each; :mod:`codegen.problems.problem` says what one consists of."""
