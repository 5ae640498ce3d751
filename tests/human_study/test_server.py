"""What the pages ask for, over HTTP."""

import pytest
from study_cases import Client, invite, make_study, served


@pytest.fixture
def study(tmp_path):
    folder = make_study(tmp_path / "study", pairs=20, agents=("peps", "sac", "drlhp"), scenes=2)
    with served(folder) as serving:
        serving.folder = folder
        yield serving


def test_a_participant_from_start_to_end(study):
    client = Client(study.address, *invite(study.folder))
    assert client.get("/api/state")["page"] == "consent"
    assert client.begin()["page"] == "pairs"
    for place in range(20):
        pair = client.get("/api/pair")
        assert (pair["place"], pair["total"]) == (place, 20)
        assert client.get("/api/pair") == pair
        status, reply = client.answer(place, ("left", "right", "equal", "unclear")[place % 4])
        assert status == 200
        assert reply["state"]["progress"] == {"done": place + 1, "total": 20}
    assert reply["state"]["page"] == "done"
    assert reply["state"]["code"]
    assert client.get("/api/pair") == {"done": True}
    assert not study.study.database.check_integrity()
