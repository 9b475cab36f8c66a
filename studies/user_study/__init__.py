"""The paper's user study, for whoever has people to ask: a page that asks them, and the analysis of what they answered.

page      a file that stands alone: two-way forced choice, the truth above, ours and the intrinsic decomposition below, sides at random
answers   what the page hands over, read and checked;  analysis   shares of preference, a table and a figure

Nothing in the project answers for people.  Answers that a program gave are marked by the page itself, stay marked in all that is made
of them, and are never mixed with people's.
"""
