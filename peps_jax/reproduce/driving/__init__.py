"""The paper's driving study (Sec. 5.2) with synthetic participants: labels on a dry road, agents in the rain, ratings of them.

One group of participants compares pieces of scenes on a dry road, in none of which anybody crashes; a sanity check leaves out
who prefers a collision. From their answers each method learns, and acts in the rain. Other participants then rate what was
learned, from 1 to 10, by what they themselves believe and want. Nobody is told which method made a scene.

scenes        what happens on the road, and what can be seen in it
participants  who they are, what they prefer, and the sanity check
comparisons   the training group's pairs and answers
ratings       the other groups' ratings, and their analysis of variance
experiment    agents learn and are rated
report        the study's files: film strips, a film, tables
"""
