"""The paper's user study, for whoever has people to ask: a page that asks them (`__main__`), and the `analysis` of what they answered.

Nothing in the project answers for people.  Answers that a program gave are marked by the page itself, stay marked in all that is made
of them, and are never mixed with people's.
"""
