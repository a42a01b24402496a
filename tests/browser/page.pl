# tests/browser/page.pl - what an operator sees and can do, from the first look to a daemon that was gone for a while. Prints TAP.
use strict;
use warnings;
use Browser;
use Rig;
use File::Temp ();
use Test::More;
use Time::HiRes qw(sleep);

plan skip_all => 'no chromium here (apt-get install chromium)' unless Browser::find();
my $rig = Rig->new(6);
$rig->start;
END { if ($rig && !Test::More->builder->is_passing) { local $?; print STDERR $rig->logs } }
my $profile = File::Temp::tempdir(CLEANUP => 1);
my $page = Browser->open($rig->url, $profile);
my $text = sub { $page->js("document.querySelector('$_[0]').textContent") };
my $is_off = sub { $page->js("document.querySelector('$_[0]').disabled") };
my $picture = sub { return unless $ENV{PICTURES}; $page->size(@_[1, 2]); $page->picture("$ENV{PICTURES}/$_[0].png") };
$page->size(1400, 900);

ok $page->until_true('document.querySelectorAll("#cameras li.ready").length === 6', 180), 'the grid shows six cameras, ready' or do { done_testing; exit 1 }; # nothing below can hold
is $text->('#rig'), 'studio <b>one</b>', 'what rigd says is text, never markup';
like $text->('#cameras li'), qr/A01.*ready.*battery 100 %.*free.*D500/, 'a camera: name, condition in a word, battery, free images, body';
ok $page->until_true('!document.querySelector("#capture").disabled'), 'the button is armed';
is $text->('#why'), 'Ready: 6 of 6 cameras.', '... and says so in words';

# every state the page shows while a take is made
$page->js('window.seen = []; new MutationObserver(() => { const t = document.querySelector("#state").textContent; if (!document.querySelector("#now").hidden && t !== seen[seen.length - 1]) seen.push(t) })'
    . '.observe(document.querySelector("#now"), { subtree: true, childList: true, characterData: true, attributes: true })');
$page->click('#capture');
ok $page->until_true('document.querySelector("#capture").disabled'), 'pressed: it cannot be pressed again';
ok $page->until_true('/verified after/.test(document.querySelector("#outcome").textContent)'), 'the button takes a take' or diag $text->('#outcome');
my $seen = join ' | ', @{ $page->js('seen') };
like $seen, qr/preflight.*collecting, \d of 6 cameras/i, 'progress: states, and how many cameras have delivered' or diag $seen;
ok $page->until_true('document.querySelectorAll("#takes li[data-take]").length === 1'), 'it is in the list of takes';
like $text->('#takes li'), qr/verified: 6 of 6 cameras, 6 frames, \d+\.\d MB/, '... with its state and figures';
ok $page->until_true('[...document.querySelectorAll("#cameras img")].filter(i => !i.hidden && i.naturalWidth > 0).length === 6'), 'each camera shows its frame';

ok $page->until_true('!document.querySelector("#capture").disabled'), 'the button is armed again'; # Enter does what the button does: nothing before
$page->js('document.querySelector("#name").focus()');
$page->call('Input.insertText', { text => 'vase' });
$page->key('Enter', 13);
ok $page->until_true('/_vase: verified/.test(document.querySelector("#outcome").textContent)'), 'keyboard alone: a name, Enter';
ok $page->until_true('!document.querySelector("#preflight").disabled'), 'and then preflight can be asked for';
$page->click('#preflight');
ok $page->until_true('!document.querySelector("#preflight-result").hidden && document.querySelector("#findings").children.length > 0'), 'preflight lists its findings' or diag $text->('#outcome');
$page->js('take({ event: "say", body: { severity: "error", camera: "A01", port: "p", text: "<img src=x onerror=window.evil=1>" } })');
like $text->('#log li'), qr/error A01 \(p\): <img src=x/, 'a message is text, never markup';
ok !$page->js('window.evil'), '... and runs nothing';

# a report comes out of a take, and may be anybody's
my ($take) = glob("$rig->{dir}/takes/*_vase");
mkdir "$take/solve", 0755;
mkdir "$take/solve/preview", 0755;
open my $f, '>', "$take/solve/preview/report.html" or die $!;
print $f '<!doctype html><title>r</title><p id="p">plain</p><script>document.getElementById("p").textContent = "script ran"</script>';
close $f;
$page->go($rig->url);
ok $page->until_true('document.querySelectorAll("#takes a").length === 1'), 'a report is linked';
is $text->('#takes a'), 'report (preview)', '... by what it is';
$page->go($page->js('document.querySelector("#takes a").href'));
ok $page->until_true('document.querySelector("#p")'), '... and opens';
is $text->('#p'), 'plain', '... but no script in it runs';
my @expected = grep { !/sandboxed/ } $page->complaints($rig->url);
is "@expected", '', 'no exception, no complaint of the policy, nothing asked of anybody else' or diag "@expected";
$page->{events} = [];
$page->go($rig->url);
ok $page->until_true('!document.querySelector("#capture").disabled && takes.length > 0'), 'back on the page';

# what this rig has not: a panorama head, and takes that are processed; as rigd tells of them
ok $page->js('document.querySelector("#panorama").hidden'), 'without [panorama] there is no button for it';
ok $page->js('document.querySelector("#arm").hidden'), '... and none to arm a trigger that cannot fire by itself';
$page->js('take({ event: "rig", body: Object.assign({}, rig, { can_arm: true, button: "takes" }) })');
ok $page->js('!document.querySelector("#arm").hidden && !document.querySelector("#arm").disabled'), 'one that can is offered to be armed';
like $text->('#why'), qr/button at the rig/, '... and what a press does before is said';
$page->js('take({ event: "rig", body: Object.assign({}, rig, { busy: true, state: "armed", button: "fires", refusal: "armed: the trigger\'s button fires; cancel (rigctl cancel) disarms" }) })');
ok $page->js('document.querySelector("#arm").disabled && !document.querySelector("#cancel").hidden'), 'armed, it can be cancelled';
like $text->('#why'), qr/Armed: the trigger's button fires/, '... and the page says so';
$page->js('take({ event: "rig", body: Object.assign({}, rig, { busy: true, state: "exposing", panorama_camera: "P01", prompt: "Turn the head to 90 degrees", take: Object.assign({}, takes[0], { id: "T", name: "lights" }),'
    . ' processing: [{ take: "20261122T100000000_vase", settled: false, steps: [{ step: "sheet", state: "done" }, { step: "develop", state: "running", n: 6, n_done: 2 }, { step: "preview", state: "waiting" }] }] }) });'
    . 'take({ event: "panorama", body: { take: "T", step: "expose", stop: 2, n_stops: 6, frame: 3, exposure: "1/60" } })');
is $text->('#prompt'), 'Turn the head to 90 degrees', 'what a person has to do is told';
ok !$page->js('document.querySelector("#continue").hidden || document.querySelector("#panorama").hidden || document.querySelector("#cancel").hidden'), '... with a button that says it is done';
is $text->('#state'), 'Lights: exposing, stop 2 of 6, exposure 3 (1/60 s).', '... and where the panorama is';
is $text->('#making'), 'vase: develop running 2 of 6; preview waiting', 'how far the processing of a take has come';
$page->go($rig->url);
ok $page->until_true('!document.querySelector("#capture").disabled && takes.length > 0'), 'back on the page';

for my $width (360, 800, 1400) {
    $page->size($width, 900);
    sleep .2;
    ok $page->js('document.scrollingElement.scrollWidth <= innerWidth'), "$width pixels wide: nothing sticks out";
    is $page->js('[...document.querySelectorAll("button, .tick, #name")].filter(b => b.offsetParent && (b.getBoundingClientRect().height < 43.5 || b.getBoundingClientRect().left < 0)).map(b => b.id).join()'), '',
        '... and everything is large enough for a finger';
    ok $page->js('document.querySelector("#capture").getBoundingClientRect().bottom < innerHeight'), '... and the button is in sight';
}
is $page->js('[...document.querySelectorAll("button, input, img, a, progress")].filter(e => !(e.textContent.trim() || e.getAttribute("aria-label") || e.alt || e.closest("label"))).length'), 0, 'every control has a name';
$picture->('desktop', 1400, 900), $picture->('tablet', 800, 1100), $picture->('phone', 360, 780);
$page->size(1400, 900);

# rigd dies; comes back without its trigger; comes back whole
$rig->stop('KILL');
ok $page->until_true('document.querySelector("#capture").disabled && /lost/.test(document.querySelector("#connection").textContent)'), 'rigd is gone: the page says so, and the button is off';
like $text->('#why'), qr/connection to rigd is lost/, '... for a reason in words';
$picture->('lost', 800, 1100);
$rig->start("$rig->{dir}/nowhere");
ok $page->until_true('document.querySelector("#connection").textContent === "connected"'), 'it is back, so is the page';
ok $page->until_true('/trigger is not there/.test(document.querySelector("#why").textContent)'), 'without a trigger the button is refused, in words' or diag $text->('#why');
ok $is_off->('#capture'), '... and off';
ok $page->until_true('document.querySelectorAll("#cameras li").length === 6'), '... and the grid is there';
$picture->('refused', 800, 1100);
cmp_ok $rig->stop, '<', 12, 'rigd ends with a page open, and does not wait until its connections are idle for too long';
$rig->start;
ok $page->until_true('!document.querySelector("#capture").disabled && document.querySelectorAll("#cameras li.ready").length === 6', 180), 'with the trigger it is armed again' or diag $text->('#why');
$page->click('#capture');
ok $page->until_true('/verified after/.test(document.querySelector("#outcome").textContent)'), '... and takes a take';
is join(' ', $page->complaints($rig->url)), '', 'no exception, no complaint';
done_testing;
