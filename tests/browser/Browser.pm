# tests/browser/Browser.pm - a headless Chromium on a leash: DevTools messages through two pipes, JSON and a zero byte each.
package Browser;
use strict;
use warnings;
use JSON::PP;
use POSIX ();
use Time::HiRes qw(time sleep);

sub find { for my $name (qw(chromium chromium-browser google-chrome)) { for my $dir (split /:/, $ENV{PATH}) { return "$dir/$name" if -x "$dir/$name" } } return }

# One page at url; dir is for its profile.
sub open {
    my ($class, $url, $dir) = @_;
    local $^F = 20; # its ends of the pipes survive exec
    pipe(my $its_in, my $out) and pipe(my $in, my $its_out) or die "pipe: $!";
    my $pid = fork // die "fork: $!";
    if (!$pid) {
        my ($r, $w) = map { fileno $_ } $its_in, $its_out;
        for my $fd ($r, $w) { $fd = POSIX::dup($fd) while $fd < 5 } # away from 3 and 4, then there
        POSIX::dup2($r, 3), POSIX::dup2($w, 4);
        CORE::open(STDOUT, '>', "$dir/chromium.log"), CORE::open(STDERR, '>&', \*STDOUT);
        $ENV{HOME} = $dir;
        exec { find() } qw(chromium --headless=new --no-sandbox --disable-gpu --disable-dev-shm-usage --no-first-run --remote-debugging-pipe --disable-background-networking),
            '--disable-component-update', "--user-data-dir=$dir/profile", 'about:blank';
    }
    close $its_in, close $its_out;
    $out->autoflush(1);
    binmode $_ for $in, $out;
    my $self = bless { pid => $pid, in => $in, out => $out, buffer => '', id => 0, events => [] }, $class;
    my $target = $self->call('Target.createTarget', { url => 'about:blank' });
    $self->{session} = $self->call('Target.attachToTarget', { targetId => $target->{targetId}, flatten => JSON::PP::true })->{sessionId};
    $self->call($_) for qw(Page.enable Runtime.enable Log.enable Network.enable);
    $self->go($url) if $url;
    return $self;
}

sub message { # the next, or undef after so many seconds
    my ($self, $seconds) = @_;
    my $end = time + $seconds;
    my $n;
    while (($n = index $self->{buffer}, "\0") < 0) {
        my $left = $end - time;
        return if $left <= 0;
        vec(my $bits = '', fileno $self->{in}, 1) = 1;
        next unless select($bits, undef, undef, $left);
        sysread($self->{in}, $self->{buffer}, 1 << 20, length $self->{buffer}) or die "chromium has left\n";
    }
    return decode_json(substr(substr($self->{buffer}, 0, $n + 1, ''), 0, $n));
}

sub call {
    my ($self, $method, $params) = @_;
    my %m = (id => ++$self->{id}, method => $method, params => $params // {});
    $m{sessionId} = $self->{session} if $self->{session};
    print { $self->{out} } encode_json(\%m), "\0";
    while (my $m = $self->message(180)) {
        if (($m->{id} // 0) == $m{id}) {
            die "$method: $m->{error}{message}\n" if $m->{error};
            return $m->{result};
        }
        push @{ $self->{events} }, $m if $m->{method};
    }
    die "$method: no answer\n";
}

sub go { $_[0]->call('Page.navigate', { url => $_[1] }) }

sub js { # the value of an expression; a promise is awaited
    my ($self, $expression) = @_;
    my $r = $self->call('Runtime.evaluate', { expression => $expression, returnByValue => JSON::PP::true, awaitPromise => JSON::PP::true });
    die "$expression: $r->{exceptionDetails}{exception}{description}\n" if $r->{exceptionDetails};
    return $r->{result}{value};
}

sub until_true { # does the expression become true?
    my ($self, $expression, $seconds) = @_;
    for (my $end = time + ($seconds // 120); time < $end; sleep .05) {
        return 1 if eval { $self->js("!!($expression)") };
    }
    return 0;
}

sub click { # where a finger would
    my ($self, $selector) = @_;
    my $r = $self->js("(() => { const e = document.querySelector('$selector'); e.scrollIntoView({ block: 'center' }); const r = e.getBoundingClientRect(); return [r.x + r.width / 2, r.y + r.height / 2] })()");
    for my $type (qw(mousePressed mouseReleased)) {
        $self->call('Input.dispatchMouseEvent', { type => $type, x => $r->[0], y => $r->[1], button => 'left', clickCount => 1 });
    }
}

sub key {
    my ($self, $key, $code) = @_;
    $self->call('Input.dispatchKeyEvent', { type => $_, key => $key, code => $key, windowsVirtualKeyCode => $code, ($_ eq 'keyDown' && $code == 13 ? (text => "\r") : ()) }) for qw(keyDown keyUp);
}

sub size { $_[0]->call('Emulation.setDeviceMetricsOverride', { width => $_[1], height => $_[2], deviceScaleFactor => 1, mobile => $_[1] < 1000 ? JSON::PP::true : JSON::PP::false }) }

sub picture { # of the whole page
    my ($self, $file) = @_;
    require MIME::Base64;
    my $r = $self->call('Page.captureScreenshot', { format => 'png', captureBeyondViewport => JSON::PP::true });
    CORE::open(my $f, '>:raw', $file) or die "$file: $!";
    print $f MIME::Base64::decode_base64($r->{data});
    close $f;
}

# What went wrong in the page since it was opened: exceptions, complaints of its policy, requests to others.
sub complaints {
    my ($self, $origin) = @_;
    my @list;
    $self->js('0');
    for my $e (@{ $self->{events} }) {
        push @list, 'exception: ' . ($e->{params}{exceptionDetails}{exception}{description} // $e->{params}{exceptionDetails}{text}) if $e->{method} eq 'Runtime.exceptionThrown';
        push @list, "$e->{params}{entry}{source}: $e->{params}{entry}{text}" if $e->{method} eq 'Log.entryAdded' && $e->{params}{entry}{level} eq 'error' && $e->{params}{entry}{source} ne 'network';
        push @list, "asks $e->{params}{request}{url}" if $e->{method} eq 'Network.requestWillBeSent' && $e->{params}{request}{url} !~ m{^(?:\Q$origin\E|data:|about:)};
    }
    return @list;
}

sub close_all {
    my ($self) = @_;
    return unless $self->{pid};
    kill 'KILL', $self->{pid};
    waitpid $self->{pid}, 0;
    delete $self->{pid};
}
sub DESTROY { local $?; $_[0]->close_all }
1;
